"""Frame stacks, in the fastest form for each device."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax._platform.by_platform import by_platform


def unpack(packed: jax.Array) -> jax.Array:
    """Unpack pixels, channels last: (..., H, W) uint32 -> (..., H, W, 3) uint8."""
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def push(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Push the newest frame onto the frame stack, (H, W, c K).

    The newest frame is (H, W), or (C, H, W) with C cameras: uint32 packed pixels for a uint8 stack,
    with c = 3 C, else numbers of the stack's dtype, with c = C. With ``is_first``, () bool, the
    stack becomes K copies of it.
    """
    return by_platform((frames, newest, is_first), frames, cpu=_concatenate, default=_shift)


def _concatenate(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Push by concatenation, which is fastest on a CPU."""
    image = unpack(newest) if frames.dtype == jnp.uint8 else newest[..., None]
    if image.ndim > 3:
        image = jnp.concatenate(list(image), axis=-1)
    channels = image.shape[-1]
    copies = jnp.tile(image, (1, 1, frames.shape[-1] // channels - 1))
    older = jnp.where(is_first, copies, frames[..., channels:])
    return jnp.concatenate([older, image], axis=-1)


def _shift(frames: jax.Array, newest: jax.Array, is_first: jax.Array) -> jax.Array:
    """Push by arithmetic on words; a GPU would write a concatenation byte by byte."""
    channel = np.arange(frames.shape[-1])
    size = 3 if frames.dtype == jnp.uint8 else 1
    planes = list(newest) if newest.ndim > 2 else [newest]
    channels = size * len(planes)
    is_new = channel >= len(channel) - channels
    repeated = planes[0][..., None]
    for c, plane in enumerate(planes[1:], 1):
        repeated = jnp.where(channel // size % len(planes) == c, plane[..., None], repeated)
    if size > 1:
        repeated = (repeated >> np.asarray(8 * (channel % 3), np.uint32)).astype(jnp.uint8)
    shifted = jnp.pad(frames[..., channels:], ((0, 0), (0, 0), (0, channels)))
    return jnp.where(is_first | is_new, repeated, shifted)
