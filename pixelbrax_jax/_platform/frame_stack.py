"""Frame stacks, in the fastest form for each device."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def unpack(packed: jax.Array) -> jax.Array:
    """Unpack pixels, channels last: (..., H, W) uint32 -> (..., H, W, 3) uint8."""
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def push(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Return the frame stack (H, W, 3 K) uint8 after one more frame, (H, W) uint32 packed pixels.

    With ``is_first``, () bool, it becomes K copies of the frame.
    """
    pushed: jax.Array = jax.lax.platform_dependent(
        frames, newest, is_first, cpu=_concatenate, default=_shift
    )
    return pushed


def _concatenate(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Push by a concatenation of frames, which is fastest on a CPU."""
    pixels = unpack(newest)
    copies = jnp.tile(pixels, (1, 1, frames.shape[-1] // 3 - 1))
    older = jnp.where(is_first, copies, frames[..., 3:])
    return jnp.concatenate([older, pixels], axis=-1)


def _shift(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Push by arithmetic on words; a GPU would write a concatenation byte by byte."""
    channel = np.arange(frames.shape[-1])
    is_new = channel >= len(channel) - 3
    shifts = np.asarray(8 * (channel % 3), np.uint32)
    repeated = (newest[..., None] >> shifts).astype(jnp.uint8)
    shifted = jnp.pad(frames[..., 3:], ((0, 0), (0, 0), (0, 3)))
    return jnp.where(is_first | is_new, repeated, shifted)
