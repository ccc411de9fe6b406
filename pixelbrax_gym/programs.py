"""Compile the programs of a stateful environment, and pack its state."""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import VectorPixelEnv, compilation
from pixelbrax_jax.flags import is_key, with_keys, without_keys
from pixelbrax_jax.types import EnvParams, EnvState, Timestep

_FEW = 32
"""Largest number of environments for which joining a state's parts is faster than passing them."""

_MANY_PROGRAMS = 64
"""Number of sets of options whose programs stay in memory."""

Array = jax.Array | np.ndarray


class Packed(NamedTuple):
    """An ``EnvState`` as few arrays, because each argument of a program costs a fixed time.

    ``frames`` are the images, with a leading axis N. ``rest`` is one (W,) uint32 array with the
    bits of all else for few environments, else the parts, with keys as ``jax.random.key_data``.
    """

    frames: Any
    rest: tuple[jax.Array, ...]


class Stepped(NamedTuple):
    """The result of a program.

    ``ended``, () or (N,) bool, tells whether a step has ended the episode. ``outputs`` may be
    handed out: the fields of a ``Timestep``, and for many environments ``done``, (N,) bool, and
    ``reported``, (N,) bool, the environments that ``info`` describes.
    """

    packed: Packed
    ended: jax.Array
    outputs: dict[str, Any]


# No program reads `spare`; `keep_unused` still lets its memory be reused.
_into_spare = compilation.jit(static_argnums=0, donate_argnames="spare", keep_unused=True)


class Programs:
    """The compiled programs that all environments with equal options share.

    Programs take and return packed states and do not modify their arguments, so an exception
    leaves the state before or after a step. New frames reuse the memory of ``spare``, frames
    that are not read again. With ``single``, actions and outputs lack the leading axis.

    ``programs_of`` makes one object per set of options: JAX compares it in every call, by identity.
    """

    def __init__(self, vector: VectorPixelEnv, single: bool) -> None:
        self.vector, self.env, self.single = vector, vector.env, single
        self._specs: dict[Any, EnvState] = {}

    def __reduce__(self) -> Any:
        """Pickle or copy the options."""
        return programs_of, (self.vector, self.single)

    @compilation.jit(static_argnums=0)
    def reset(self, seeds: Array, params: EnvParams, offsets: Array | None) -> Stepped:
        """Start episode 0 of (N,) uint32 seeds, with (N,) int32 ``time_limit_offset``."""
        state, timestep = self.vector.reset(jax.vmap(jax.random.key)(seeds), params)
        return self._stepped(_with_offsets(state, offsets), timestep)

    @_into_spare
    def reset_where(
        self,
        packed: Packed,
        mask: Array,
        reported: Array,
        params: EnvParams,
        seeds: Array | None,
        offsets: Array | None,
        spare: Any,
    ) -> Stepped:
        """Reset environments where ``mask``; infos describe those where ``reported``, (N,) bool."""
        del spare
        key = None if seeds is None else jax.vmap(jax.random.key)(seeds)
        state = self._state(packed, params)
        state, timestep = self.vector.reset_where(state, mask, params, key)
        return self._stepped(_with_offsets(state, offsets), timestep, reported)

    @_into_spare
    def step(
        self,
        packed: Packed,
        action: Array,
        params: EnvParams,
        spare: Any,
        mask: Array | None = None,
    ) -> Stepped:
        """Step where ``mask``, or all; others repeat their observation with ``done`` False."""
        del spare
        state = self._state(packed, params)
        action = action[None] if self.single else action
        stepped, timestep = self.vector.step(state, action, params)
        if mask is None:
            return self._stepped(stepped, timestep)
        state = _where(mask, stepped, state)
        packed, ended, outputs = self._stepped(state, timestep.replace(obs=self.vector.obs(state)))
        return Stepped(packed, ended & mask, outputs | {"done": outputs["done"] & mask})

    @compilation.jit(static_argnums=0)
    def state(self, packed: Packed, params: EnvParams) -> EnvState:
        """Return the states, without the leading axis for a single environment."""
        state = self._state(packed, params)
        return jax.tree.map(lambda x: x[0], state) if self.single else state

    @compilation.jit(static_argnums=0)
    def start(
        self, state: EnvState, params: EnvParams, packed: Packed | None, mask: Array | None
    ) -> Stepped:
        """Continue from ``state`` (a row if ``single``) where ``mask``, else from ``packed``."""
        if self.single:
            state = jax.tree.map(lambda x: x[None], state)
        if packed is not None and mask is not None:
            state = _where(mask, state, self._state(packed, params))
        rewards = jnp.zeros(self.vector.num_envs)
        see = jax.vmap(self.vector.env.timestep, in_axes=(0, 0, None))
        return self._stepped(state, see(state, rewards, params), mask)

    @compilation.jit(static_argnums=(0, 3, 4))
    def images(self, packed: Packed, params: EnvParams, height: int, width: int) -> jax.Array:
        """Render (N, height, width, 3) uint8 images of the states."""
        image = jax.vmap(lambda row: self.env.image(row, params, height, width))
        return image(self._state(packed, params))

    def check_state(self, state: Any, params: EnvParams) -> None:
        """Reject a state that does not fit; the message names the first difference."""
        if not isinstance(state, EnvState):
            raise TypeError(
                f"a state must be an EnvState from get_state(), got {type(state).__name__}."
            )
        wanted: Any = jax.tree_util.tree_flatten_with_path(self._spec(params))
        given: Any = jax.tree.flatten(state)
        if given[1] != wanted[1]:
            raise ValueError(
                f"the state does not have the structure of this environment's state (it has "
                f"{len(given[0])} arrays, expected {len(wanted[0])}): use a state of an "
                "environment with the same task, physics backend, distractors, number of "
                "cameras, names in camera_sizes and obs_mode."
            )
        for value, (path, spec) in zip(given[0], wanted[0], strict=True):
            shape, dtype = np.shape(value), getattr(value, "dtype", type(value).__name__)
            expected = spec.shape[1:] if self.single else spec.shape
            if (shape, dtype) != (expected, spec.dtype):
                raise ValueError(
                    f"state{jax.tree_util.keystr(path)} must be {spec.dtype} of shape {expected}, "
                    f"got {dtype} of shape {shape}."
                )

    def _spec(self, params: EnvParams) -> EnvState:
        """Return the shapes and dtypes of the states, with their leading axis."""
        leaves, tree = jax.tree.flatten(params)
        key = tree, tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        if key not in self._specs:
            seeds = jax.ShapeDtypeStruct((self.vector.num_envs,), np.uint32)
            keys = jax.eval_shape(jax.vmap(jax.random.key), seeds)
            self._specs[key] = jax.eval_shape(self.vector.reset, keys, params)[0]
        return self._specs[key]

    def _state(self, packed: Packed, params: EnvParams) -> EnvState:
        return unpack(packed, self._spec(params))

    def _stepped(
        self, state: EnvState, timestep: Timestep, reported: Array | None = None
    ) -> Stepped:
        ended = timestep.terminated | timestep.truncated
        outputs = dict(vars(timestep))
        if self.single:
            return Stepped(pack(state), ended[0], jax.tree.map(lambda x: x[0], outputs))
        if reported is None:
            reported = jnp.ones(self.vector.num_envs, bool)
        return Stepped(pack(state), ended, outputs | {"done": ended, "reported": reported})


@lru_cache(_MANY_PROGRAMS)
def programs_of(vector: VectorPixelEnv, single: bool) -> Programs:
    """Return the programs of environments, the same object for equal environments."""
    return Programs(vector, single)


def pack(state: EnvState) -> Packed:
    """Pack a state with a leading axis N."""
    parts = jax.tree.leaves(state.replace(frames=None))
    if len(state.key) > _FEW:
        return Packed(state.frames, tuple(map(without_keys, parts)))
    # Without a barrier, XLA would fuse the computation of the parts into the loop that writes them.
    parts = jax.lax.optimization_barrier([without_keys(part) for part in parts])
    return Packed(state.frames, (jnp.concatenate([_words(part) for part in parts]),))


def unpack(packed: Packed, like: EnvState) -> EnvState:
    """Invert ``pack`` exactly; ``like`` has the shapes and dtypes of the state."""
    parts, tree = jax.tree.flatten(like.replace(frames=None))
    if like.key.shape[0] > _FEW:
        restored = list(map(with_keys, packed.rest, parts))
    else:
        sizes = [
            jax.eval_shape(lambda part: _words(without_keys(part)), part).size for part in parts
        ]
        (words,) = packed.rest
        restored = [
            _from_words(words[end - size : end], part)
            for part, size, end in zip(parts, sizes, accumulate(sizes), strict=True)
        ]
    state: EnvState = jax.tree.unflatten(tree, restored)
    return state.replace(frames=packed.frames)


def _where(mask: Array, state: EnvState, otherwise: EnvState) -> EnvState:
    def choose(here: Array, new: EnvState, old: EnvState) -> EnvState:
        return jax.tree.map(partial(jnp.where, here), new, old)

    return jax.vmap(choose)(mask, state, otherwise)


def _with_offsets(state: EnvState, offsets: Array | None) -> EnvState:
    if offsets is None:
        return state
    return state.replace(sim=state.sim.replace(time_limit_offset=offsets))


def _words(part: jax.Array) -> jax.Array:
    """Return the bits of an array as (W,) uint32, one word per element of a narrow dtype."""
    if (size := part.dtype.itemsize) < 4:
        part = part.view(f"uint{8 * size}").astype(jnp.uint32)
    return part.ravel().view(jnp.uint32)


def _from_words(words: jax.Array, like: Any) -> jax.Array:
    """Invert ``_words`` for an array with the shape and dtype of ``like``."""
    if is_key(like.dtype):
        data = jax.eval_shape(jax.random.key_data, like)
        return with_keys(words.reshape(data.shape), like)
    if (size := like.dtype.itemsize) < 4:
        words = words.astype(f"uint{8 * size}")
    return words.view(like.dtype).reshape(like.shape)
