"""A convolution that is fast inside loops, on a CPU too."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from pixelbrax_jax._platform.lowering import by_platform

Pads = tuple[tuple[int, int], tuple[int, int]]


class Conv(nn.Module):
    """A convolution with a bias, of channels-last images; as ``flax.linen.Conv``.

    Attributes:
        features: channels of the result.
        size: height and width of the kernel.
        stride: of the kernel.
        padding: ``"SAME"`` or ``"VALID"``.
    """

    features: int
    size: int
    stride: int = 1
    padding: str = "VALID"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) float32 to (B, H', W', features)."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        rows, columns = jax.lax.padtype_to_pads(
            x.shape[1:3], shape[:2], (self.stride, self.stride), self.padding
        )
        return convolve(x, kernel, self.stride, (rows, columns)) + bias


def convolve(x: jax.Array, kernel: jax.Array, stride: int, pads: Pads) -> jax.Array:
    """Return cross-correlation of (B, H, W, C) with (h, w, C, D), padded by zeros.

    XLA's own convolution on a CPU, and its derivatives above all, reach a fraction of the speed of
    matrix products within ``lax.scan``. There it is written as products.
    """

    def products(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return _as_products(x, kernel, stride, pads)

    def native(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), pads, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    result: jax.Array = by_platform(x, kernel, cpu=products, default=native)
    return result


def _as_products(x: jax.Array, kernel: jax.Array, stride: int, pads: Pads) -> jax.Array:
    """Return the convolution as a sum of matrix products.

    The image is cut into blocks of stride x stride pixels, whose channels are put side by side:
    over blocks the stride is 1, and each place of the kernel adds one product.
    """
    batch, height, width, channels = x.shape
    (top, bottom), (left, right) = pads
    rows = (top + height + bottom - kernel.shape[0]) // stride + 1
    columns = (left + width + right - kernel.shape[1]) // stride + 1
    # Blocks of a kernel, and of the image as far as the last place of the kernel reaches.
    tall, wide = (-(-side // stride) for side in kernel.shape[:2])
    down, across = rows + tall - 1, columns + wide - 1
    borders = (
        (0, 0, 0),
        (top, down * stride - top - height, 0),
        (left, across * stride - left - width, 0),
        (0, 0, 0),
    )
    x = jax.lax.pad(x, jnp.zeros((), x.dtype), borders)
    x = x.reshape(batch, down, stride, across, stride, channels).transpose(0, 1, 3, 2, 4, 5)
    x = x.reshape(batch, down, across, -1)
    missing = ((0, tall * stride - kernel.shape[0]), (0, wide * stride - kernel.shape[1]))
    kernel = jnp.pad(kernel, (*missing, (0, 0), (0, 0)))
    kernel = kernel.reshape(tall, stride, wide, stride, channels, -1).transpose(0, 2, 1, 3, 4, 5)
    kernel = kernel.reshape(tall, wide, x.shape[-1], -1)
    result = jnp.zeros((), x.dtype)
    for i in range(tall):
        for j in range(wide):
            result += x[:, i : i + rows, j : j + columns] @ kernel[i, j]
    return result
