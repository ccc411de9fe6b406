"""States of environments as two arrays, however many parts they have."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.types import EnvState


class Packed(NamedTuple):
    """An ``EnvState`` as two arrays.

    The arguments and results of a compiled program cost a fixed time each. With the 40 or so parts
    of a state, one environment spends a tenth of its step on them.

    Attributes:
        frames: (N, H, W, 3K) uint8, as in the state.
        words: (W,) uint32, the bits of all else, one part after the other.
    """

    frames: jax.Array
    words: jax.Array


def pack(state: EnvState) -> Packed:
    """Return a state as two arrays."""
    parts = jax.tree.leaves(state.replace(frames=None))
    return Packed(state.frames, jnp.concatenate([_words(part) for part in parts]))


def unpack(packed: Packed, like: EnvState) -> EnvState:
    """Return the state that ``pack`` was given, to the bit.

    Args:
        packed: what it returned.
        like: a state of the same shapes, also of ``jax.ShapeDtypeStruct``.
    """
    parts, tree = jax.tree.flatten(like.replace(frames=None))
    sizes = [jax.eval_shape(_words, part).size for part in parts]
    ends = accumulate(sizes)
    restored = [
        _from_words(packed.words[end - size : end], part)
        for part, size, end in zip(parts, sizes, ends, strict=True)
    ]
    state: EnvState = jax.tree.unflatten(tree, restored)
    return state.replace(frames=packed.frames)


def _is_key(part: Any) -> bool:
    return jnp.issubdtype(part.dtype, jax.dtypes.prng_key)


def _words(part: jax.Array) -> jax.Array:
    """Return the bits of an array, (W,) uint32; of a narrow type, one number a word."""
    if _is_key(part):
        part = jax.random.key_data(part)
    if part.dtype == bool:
        part = part.astype(jnp.uint8)
    bits = part.dtype.itemsize * 8
    if bits < 32:
        part = jax.lax.bitcast_convert_type(part, f"uint{bits}").astype(jnp.uint32)
    return jax.lax.bitcast_convert_type(part, jnp.uint32).ravel()


def _from_words(words: jax.Array, like: Any) -> jax.Array:
    """Return what ``_words`` was given, of the shape and type of ``like``."""
    if _is_key(like):
        data = jax.eval_shape(jax.random.key_data, like)
        impl = jax.random.key_impl(jnp.empty((), like.dtype))
        return jax.random.wrap_key_data(words.reshape(data.shape), impl=impl)
    if like.dtype == bool:
        return words.reshape(like.shape).astype(bool)
    bits = like.dtype.itemsize * 8
    if bits < 32:
        words = words.astype(f"uint{bits}")
    wide = (*like.shape, bits // 32) if bits > 32 else like.shape
    assert math.prod(wide) == words.size
    return jax.lax.bitcast_convert_type(words.reshape(wide), like.dtype)
