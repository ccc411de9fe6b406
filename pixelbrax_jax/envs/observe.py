"""Frames -> what the agent sees. The only place where colors are rounded."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax.types import Frame


def pack(frame: Frame) -> jax.Array:
    """A frame as one 32-bit word a pixel: red in the low byte, then green, then blue.

    Returns:
        (H, W) uint32; each channel is ``floor(255 x + 1/2)``.
    """

    def level(plane: jax.Array) -> jax.Array:
        return (plane * 255.0 + 0.5).astype(jnp.uint32)

    return level(frame.r) | level(frame.g) << 8 | level(frame.b) << 16


def unpack(words: jax.Array) -> jax.Array:
    """Packed pixels as channels-last ones: (..., H, W) uint32 -> (..., H, W, 3) uint8."""
    return jax.lax.bitcast_convert_type(words, jnp.uint8)[..., :3]


def push(frames: jax.Array, newest: jax.Array, cleared: jax.Array) -> jax.Array:
    """The frame stack after one more frame.

    Args:
        frames: (H, W, 3 K) uint8, oldest first.
        newest: (H, W) uint32, packed.
        cleared: () bool, an episode begins: the stack becomes K copies of ``newest``.

    Returns:
        (H, W, 3 K) uint8.
    """
    pixels = unpack(newest)
    copies = jnp.tile(pixels, (1, 1, frames.shape[-1] // 3 - 1))
    older = jnp.where(cleared, copies, frames[..., 3:])
    return jnp.concatenate([older, pixels], axis=-1)
