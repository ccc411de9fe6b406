"""Convolutions that are fast on a CPU too, also in loops and gradients."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

Pads = tuple[tuple[int, int], tuple[int, int]]
"""Rows above and below, columns to the left and to the right."""

Before = Callable[[jax.Array], jax.Array]
"""An elementwise function."""


def unchanged(x: jax.Array) -> jax.Array:
    """Return ``x``."""
    return x


# Outside a program it is also compiled once.
@partial(jax.jit, static_argnums=(2, 3, 4), inline=True)
def convolve(
    x: jax.Array, kernel: jax.Array, stride: int, pads: Pads, before: Before = unchanged
) -> jax.Array:
    """Cross-correlate ``before(x)``, (B, H, W, C), with (h, w, C, D).

    On a CPU only derivatives in reverse mode exist (``jax.grad``, also nested).
    """

    def native(x: jax.Array, kernel: jax.Array) -> jax.Array:
        x = before(x).astype(kernel.dtype)
        return jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), pads, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    def on_cpu(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return _by_image(x, kernel, stride, pads, before)

    return jax.lax.platform_dependent(x, kernel, cpu=on_cpu, default=native)


# The patches of one image fit into a cache, those of a batch do not. XLA's own convolutions are as
# fast only in some shapes, and its gradients of them are many times slower in loops.


@partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def _by_image(
    x: jax.Array, kernel: jax.Array, stride: int, pads: Pads, before: Before
) -> jax.Array:
    def convolved(image: jax.Array) -> jax.Array:
        return _patches(image, kernel, stride, pads, before) @ _matrix(kernel)

    result = _on_each_device(partial(jax.lax.map, convolved), x)
    return result.reshape(x.shape[0], *result.shape[2:])


def _by_image_forward(
    x: jax.Array, kernel: jax.Array, stride: int, pads: Pads, before: Before
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return _by_image(x, kernel, stride, pads, before), (x, kernel)


def _by_image_backward(
    stride: int,
    pads: Pads,
    before: Before,
    inputs: tuple[jax.Array, jax.Array],
    cotangents: jax.Array,
) -> tuple[jax.Array | None, jax.Array]:
    x, kernel = inputs
    of_images = jnp.issubdtype(x.dtype, jnp.floating)

    def add(of_matrix: jax.Array, one: Any) -> tuple[jax.Array, jax.Array | None]:
        image, cotangent = one
        patches, pull = jax.vjp(lambda image: _patches(image, kernel, stride, pads, before), image)
        # This order is faster than that of the transpose.
        of_matrix += jnp.einsum(
            "hwd,hwp->dp", cotangent, patches, preferred_element_type=jnp.float32
        )
        return of_matrix, pull(cotangent @ _matrix(kernel).T)[0] if of_images else None

    def loop(*one: jax.Array) -> Any:
        return jax.lax.scan(add, jnp.zeros(_matrix(kernel).T.shape), one)

    of_matrix, of_x = _on_each_device(loop, x, cotangents)
    of_kernel = of_matrix.sum(0).T.reshape(kernel.shape).astype(kernel.dtype)
    return of_x if of_x is None else of_x.reshape(x.shape), of_kernel


_by_image.defvjp(_by_image_forward, _by_image_backward)


def _on_each_device(loop: Callable[..., Any], *batches: jax.Array) -> Any:
    """Run a loop over each device's part of a batch; return the results, (parts, ...).

    XLA does not divide a loop over a sharded axis: every device would compute all images. It still
    does so if JAX's devices do not divide the batch, or only some of them hold it.
    """
    devices, size = jax.device_count(), batches[0].shape[0]
    # Policies are exported for batches of any size.
    if devices == 1 or not isinstance(size, int) or size % devices:
        return jax.tree.map(lambda x: x[None], loop(*batches))
    return jax.vmap(loop)(*(x.reshape(devices, -1, *x.shape[1:]) for x in batches))


def _patches(
    image: jax.Array, kernel: jax.Array, stride: int, pads: Pads, before: Before
) -> jax.Array:
    """Return the patch under the kernel at each position, (H', W', h * w * C)."""
    image = jnp.pad(before(image).astype(kernel.dtype), (*pads, (0, 0)))
    height, width = kernel.shape[:2]
    rows, columns = (
        max(0, (whole - side) // stride + 1)
        for whole, side in zip(image.shape, (height, width), strict=False)
    )
    return jnp.concatenate(
        [
            image[i : i + rows * stride : stride, j : j + columns * stride : stride]
            for i in range(height)
            for j in range(width)
        ],
        -1,
    )


def _matrix(kernel: jax.Array) -> jax.Array:
    return kernel.reshape(-1, kernel.shape[-1])
