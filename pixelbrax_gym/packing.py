"""States of environments as arrays, of few environments as two."""

from __future__ import annotations

from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.types import EnvState

_FEW = 32
"""Environments up to which it is faster to put the parts of a state together than to pass them."""


class Packed(NamedTuple):
    """An ``EnvState`` as arrays.

    The arguments and results of a compiled program cost a fixed time each. With the 40 or so parts
    of a state, one environment spends a tenth of its step on them.

    Attributes:
        frames: (N, H, W, 3K) uint8, as in the state.
        rest: of few environments one array, (W,) uint32, the bits of all else, one part after the
            other; of many the parts, keys as what ``jax.random.key_data`` makes of them.
    """

    frames: jax.Array
    rest: tuple[jax.Array, ...]


def pack(state: EnvState) -> Packed:
    """Return a state, with a leading axis N, as arrays."""
    parts = jax.tree.leaves(state.replace(frames=None))
    if len(state.frames) > _FEW:
        return Packed(state.frames, tuple(map(_data, parts)))
    # Without a barrier, what computes the parts is compiled into the loop that writes them.
    parts = jax.lax.optimization_barrier(parts)
    return Packed(state.frames, (jnp.concatenate([_words(part) for part in parts]),))


def unpack(packed: Packed, like: EnvState) -> EnvState:
    """Return the state that ``pack`` was given, to the bit.

    Args:
        packed: what it returned.
        like: a state of the same shapes, also of ``jax.ShapeDtypeStruct``.
    """
    parts, tree = jax.tree.flatten(like.replace(frames=None))
    if like.frames.shape[0] > _FEW:
        restored = list(map(_from_data, packed.rest, parts))
    else:
        sizes = [jax.eval_shape(_words, part).size for part in parts]
        (words,) = packed.rest
        restored = [
            _from_words(words[end - size : end], part)
            for part, size, end in zip(parts, sizes, accumulate(sizes), strict=True)
        ]
    state: EnvState = jax.tree.unflatten(tree, restored)
    return state.replace(frames=packed.frames)


def _is_key(part: Any) -> bool:
    return jnp.issubdtype(part.dtype, jax.dtypes.prng_key)


def _data(part: jax.Array) -> jax.Array:
    return jax.random.key_data(part) if _is_key(part) else part


def _from_data(data: jax.Array, like: Any) -> jax.Array:
    if not _is_key(like):
        return data
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(jnp.empty((), like.dtype)))


def _words(part: jax.Array) -> jax.Array:
    """Return the bits of an array, (W,) uint32; of a narrow type, one number a word."""
    part = _data(part)
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
        return _from_data(words.reshape(data.shape), like)
    if like.dtype == bool:
        return words.reshape(like.shape).astype(bool)
    bits = like.dtype.itemsize * 8
    if bits < 32:
        words = words.astype(f"uint{bits}")
    shape = (*like.shape, bits // 32) if bits > 32 else like.shape
    return jax.lax.bitcast_convert_type(words.reshape(shape), like.dtype)
