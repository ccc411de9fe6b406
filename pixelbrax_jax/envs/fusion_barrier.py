"""The form in which each platform draws an image, once for all who read it."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

_BANDS = 2
"""Parts in which an accelerator draws an image, one above the other: a loop of one is none."""


def fusion_barrier(
    draw_rows: Callable[[jax.Array, int], jax.Array],
    height: int,
    width: int,
    kernel: Callable[[], jax.Array] | None = None,
) -> jax.Array:
    """Draw an image that XLA computes once, whoever reads it.

    Without a barrier the renderer is fused into every reader of its image and runs again for each.
    Nothing is fused into a kernel of its own. Where there is none, control flow is a barrier that
    XLA keeps: on a CPU a conditional, for which a GPU would wait for the host; on a TPU an
    optimization barrier is enough; elsewhere a loop over bands, which also halves what XLA keeps of
    an image that it does not fuse.

    Args:
        draw_rows: ``draw_rows(first_row, num_rows)``, (num_rows, width) uint32 rows of the image.
            Beyond its last row anything may be drawn.
        height: pixels.
        width: pixels.
        kernel: draws the image by a kernel for CUDA; None for none.

    Returns:
        (height, width) uint32.
    """

    def draw_in_bands() -> jax.Array:
        num_rows = -(-height // _BANDS)
        first_rows = jnp.arange(_BANDS) * num_rows
        bands = jax.lax.map(lambda first_row: draw_rows(first_row, num_rows), first_rows)
        return bands.reshape(-1, width)[:height]

    def draw_at_once() -> jax.Array:
        # On a CPU, XLA clears the result of a loop beforehand, and runs in one thread whatever is
        # fused into the writes to it. A conditional costs nothing; were it known to be always
        # taken, the compiler would remove it, and the barrier with it.
        zero = jax.lax.optimization_barrier(jnp.int32(0))
        blank = jnp.zeros(height * width, jnp.uint32)
        # In one axis, as the renderer computes it.
        image = jax.lax.cond(zero == 0, lambda: draw_rows(zero, height).ravel(), lambda: blank)
        return image.reshape(height, width)

    def draw_behind_a_barrier() -> jax.Array:
        # A TPU's compiler keeps it, and keeps less of an image than of its bands in a loop.
        return jax.lax.optimization_barrier(draw_rows(jnp.int32(0), height))

    forms = {} if kernel is None else {"cuda": kernel}
    image: jax.Array = jax.lax.platform_dependent(
        cpu=draw_at_once, tpu=draw_behind_a_barrier, default=draw_in_bands, **forms
    )
    return image
