"""Frames -> what the agent sees. The only place where colors are rounded."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.types import Frame


def pack(frame: Frame) -> jax.Array:
    """Pack a frame into 32 bits a pixel: red in the low byte, then green, then blue.

    Returns:
        (H, W) uint32; each channel is ``floor(255 x + 1/2)``.
    """

    def level(plane: jax.Array) -> jax.Array:
        return (plane * 255.0 + 0.5).astype(jnp.uint32)

    return level(frame.r) | level(frame.g) << 8 | level(frame.b) << 16


def unpack(packed: jax.Array) -> jax.Array:
    """Unpack pixels, channels last: (..., H, W) uint32 -> (..., H, W, 3) uint8."""
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def push(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Return the frame stack after one more frame.

    Args:
        frames: (H, W, 3 K) uint8, oldest first.
        newest: (H, W) uint32 packed pixels.
        is_first: () bool, the first frame of an episode: the stack becomes K copies of ``newest``.

    Returns:
        (H, W, 3 K) uint8.
    """
    pushed: jax.Array = jax.lax.platform_dependent(
        frames, newest, is_first, cpu=_concatenate, default=_shift
    )
    return pushed


def _concatenate(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """See ``push``; one frame after the other, as a CPU copies fastest."""
    pixels = unpack(newest)
    copies = jnp.tile(pixels, (1, 1, frames.shape[-1] // 3 - 1))
    older = jnp.where(is_first, copies, frames[..., 3:])
    return jnp.concatenate([older, pixels], axis=-1)


def _shift(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """See ``push``; number by number.

    A GPU writes a concatenation of bytes byte by byte, and this in words.
    """
    channel = np.arange(frames.shape[-1])
    is_new = channel >= len(channel) - 3
    shifts = np.asarray(8 * (channel % 3), np.uint32)
    repeated = (newest[..., None] >> shifts).astype(jnp.uint8)
    shifted = jnp.pad(frames[..., 3:], ((0, 0), (0, 0), (0, 3)))
    return jnp.where(is_first | is_new, repeated, shifted)
