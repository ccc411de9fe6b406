"""A convolution whose gradient is fast inside loops, on a CPU too."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from flax import linen as nn

_LAYOUT = ("NHWC", "HWIO", "NHWC")

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
        pads = jax.lax.padtype_to_pads(
            x.shape[1:3], shape[:2], (self.stride, self.stride), self.padding
        )
        return convolve(x, kernel, self.stride, tuple(pads)) + bias


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def convolve(x: jax.Array, kernel: jax.Array, stride: int, pads: Pads) -> jax.Array:
    """Return cross-correlation of (B, H, W, C) with (h, w, C, D), padded by zeros.

    The derivatives of a convolution are convolutions of tensors whose axes play other roles. XLA
    brings them into the form that its fast kernels for CPUs take, but only outside of loops:
    within ``lax.scan`` they run 10 to 20 times slower. Here they are written in that form.
    """
    return _convolve(x, kernel, stride, pads)


def _convolve(x: jax.Array, kernel: jax.Array, stride: int, pads: Pads) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), pads, dimension_numbers=_LAYOUT
    )


def _forward(
    x: jax.Array, kernel: jax.Array, stride: int, pads: Pads
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return _convolve(x, kernel, stride, pads), (x, kernel)


def _backward(
    stride: int, pads: Pads, kept: tuple[jax.Array, jax.Array], slope: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, kernel = kept

    def canonical(x: jax.Array, kernel: jax.Array, slope: jax.Array) -> Sequence[jax.Array]:
        return _slope_of_x(x, kernel, slope, stride, pads), _slope_of_kernel(
            x, kernel, slope, stride, pads
        )

    def native(x: jax.Array, kernel: jax.Array, slope: jax.Array) -> Sequence[jax.Array]:
        return jax.vjp(lambda x, kernel: _convolve(x, kernel, stride, pads), x, kernel)[1](slope)

    slopes = jax.lax.platform_dependent(x, kernel, slope, cpu=canonical, default=native)
    return slopes[0], slopes[1]


def _slope_of_x(
    x: jax.Array, kernel: jax.Array, slope: jax.Array, stride: int, pads: Pads
) -> jax.Array:
    """Return the slope, with zeros between its pixels, convolved with the kernel turned round."""
    before = [size - 1 - pad[0] for size, pad in zip(kernel.shape, pads, strict=False)]
    after = [
        # What is missing to the size of x.
        x.shape[1 + i] + kernel.shape[i] - 2 - (slope.shape[1 + i] - 1) * stride - before[i]
        for i in range(2)
    ]
    return jax.lax.conv_general_dilated(
        slope,
        jnp.transpose(kernel[::-1, ::-1], (0, 1, 3, 2)),
        (1, 1),
        list(zip(before, after, strict=True)),
        lhs_dilation=(stride, stride),
        dimension_numbers=_LAYOUT,
    )


def _slope_of_kernel(
    x: jax.Array, kernel: jax.Array, slope: jax.Array, stride: int, pads: Pads
) -> jax.Array:
    """Return channels of x as images, convolved with the slope as a kernel; sums over the batch."""
    after = [
        # Negative where the kernel never reached the last pixels.
        kernel.shape[i] - 1 + (slope.shape[1 + i] - 1) * stride + 1 - x.shape[1 + i] - pads[i][0]
        for i in range(2)
    ]
    moved = jax.lax.conv_general_dilated(
        jnp.transpose(x, (3, 1, 2, 0)),
        jnp.transpose(slope, (1, 2, 0, 3)),
        (1, 1),
        [(pads[i][0], after[i]) for i in range(2)],
        rhs_dilation=(stride, stride),
        dimension_numbers=_LAYOUT,
    )
    return jnp.transpose(moved, (1, 2, 0, 3))


convolve.defvjp(_forward, _backward)
