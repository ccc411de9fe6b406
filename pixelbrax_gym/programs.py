"""The compiled programs behind an environment that keeps its state."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_gym.packing import Packed, pack, unpack
from pixelbrax_jax import PixelEnv, VectorPixelEnv, compilation
from pixelbrax_jax.types import EnvParams, EnvState, Timestep

Array = jax.Array | np.ndarray
Stepped = tuple[Packed, dict[str, Any]]


def _env(programs: Programs) -> PixelEnv:
    return programs.vector.env


# A `spare` is read by nothing; `keep_unused` lets it be written to all the same.
_into_spare = compilation.jit(_env, static_argnums=0, donate_argnames="spare", keep_unused=True)


class Programs:
    """The compiled programs of one set of options, which all environments with equal ones share.

    States go in and come out packed, and stay as they are: an exception that arrives at any time
    leaves the state before a step or the one after. Frames are written into ``spare``, the
    memory of frames that nothing reads any more, or memory would be asked for in each step.
    Outputs are never read again, which is why they can be given away.

    Objects are made by ``programs_of`` and equal to themselves alone. JAX compares them in every
    call, and an exception out of a comparison in Python would arrive as one of JAX's own.

    Attributes:
        vector: the environments.
        single: whether actions and outputs lack the leading axis; there is one environment then.
    """

    def __init__(self, vector: VectorPixelEnv, single: bool) -> None:
        """Compile nothing yet."""
        self.vector, self.single = vector, single
        self._specs: dict[Any, EnvState] = {}

    def __reduce__(self) -> Any:
        """Return what is pickled or copied: the options."""
        return programs_of, (self.vector, self.single)

    @compilation.jit(_env, static_argnums=0)
    def reset(self, seeds: Array, params: EnvParams, offsets: Array | None) -> Stepped:
        """Reset all environments to episode 0 of their (N,) uint32 seeds.

        Args:
            seeds: as above.
            params: of all.
            offsets: (N,) int32, new ``time_limit_offset`` of all; None keeps what a reset makes.
        """
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
        spare: Array,
    ) -> Stepped:
        """Reset some environments; infos are about those that ``reported`` names, (N,) bool."""
        del spare
        key = None if seeds is None else jax.vmap(jax.random.key)(seeds)
        state = self._state(packed, params)
        state, timestep = self.vector.reset_where(state, mask, params, key)
        return self._stepped(_with_offsets(state, offsets), timestep, reported)

    @_into_spare
    def step(self, packed: Packed, action: Array, params: EnvParams, spare: Array) -> Stepped:
        """Step all environments."""
        del spare
        return self._stepped(*self._step(self._state(packed, params), action, params))

    @_into_spare
    def step_where(
        self, packed: Packed, mask: Array, action: Array, params: EnvParams, spare: Array
    ) -> Stepped:
        """Step some environments; the others repeat their observation, with ``done`` False."""
        del spare
        state = self._state(packed, params)
        stepped, timestep = self._step(state, action, params)
        state = self._where(mask, stepped, state)
        packed, outputs = self._stepped(state, timestep.replace(obs=self.vector.obs(state)))
        return packed, outputs | {"done": outputs["done"] & mask}

    @compilation.jit(_env, static_argnums=0)
    def state(self, packed: Packed, params: EnvParams) -> EnvState:
        """Return the states, without the leading axis of a single environment."""
        state = self._state(packed, params)
        return jax.tree.map(lambda x: x[0], state) if self.single else state

    @compilation.jit(_env, static_argnums=0)
    def start(self, state: EnvState, params: EnvParams) -> Stepped:
        """Go on from given states, which lack the leading axis of a single environment."""
        if self.single:
            state = jax.tree.map(lambda x: x[None], state)
        return self._started(state, params)

    @compilation.jit(_env, static_argnums=0)
    def start_where(
        self, packed: Packed, mask: Array, state: EnvState, params: EnvParams
    ) -> Stepped:
        """Go on from given states where (N,) ``mask``; the others stay as they are."""
        return self._started(self._where(mask, state, self._state(packed, params)), params)

    @compilation.jit(_env, static_argnums=(0, 3, 4))
    def images(self, packed: Packed, params: EnvParams, height: int, width: int) -> jax.Array:
        """Draw the states, (N, height, width, 3) uint8."""
        env, state = self.vector.env, self._state(packed, params)
        images: jax.Array = jax.vmap(lambda row: env.image(row, params, height, width))(state)
        return images

    def state_spec(self, params: EnvParams) -> EnvState:
        """Return shapes and dtypes of what ``state`` returns and ``start`` takes."""
        spec: EnvState = self._spec(params)
        if not self.single:
            return spec
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), spec)

    def _spec(self, params: EnvParams) -> Any:
        leaves, tree = jax.tree.flatten(params)
        key = tree, tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        if key not in self._specs:
            self._specs[key] = self._make_spec(params)
        return self._specs[key]

    def _make_spec(self, params: EnvParams) -> Any:
        seeds = jax.ShapeDtypeStruct((self.vector.num_envs,), np.uint32)
        keys = jax.eval_shape(jax.vmap(jax.random.key), seeds)
        return jax.eval_shape(self.vector.reset, keys, params)[0]

    def _state(self, packed: Packed, params: EnvParams) -> EnvState:
        return unpack(packed, self._spec(params))

    def _started(self, state: EnvState, params: EnvParams) -> Stepped:
        rewards = jnp.zeros(self.vector.num_envs)
        see = jax.vmap(self.vector.env.timestep, in_axes=(0, 0, None))
        return self._stepped(state, see(state, rewards, params))

    def _stepped(
        self, state: EnvState, timestep: Timestep, reported: Array | None = None
    ) -> Stepped:
        """Pack states, and return them and outputs; infos are about (N,) ``reported``."""
        reported = jnp.ones(self.vector.num_envs, bool) if reported is None else reported
        return pack(state), self._outputs(timestep, reported)

    @staticmethod
    def _where(mask: Array, state: EnvState, otherwise: EnvState) -> EnvState:
        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)

        chosen: EnvState = jax.tree.map(choose, state, otherwise)
        return chosen

    def _step(self, state: EnvState, action: Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        return self.vector.step(state, action[None] if self.single else action, params)

    def _outputs(self, timestep: Timestep, reported: Array) -> dict[str, Any]:
        done = timestep.terminated | timestep.truncated
        outputs = {
            "obs": timestep.obs,
            "reward": timestep.reward,
            "terminated": timestep.terminated,
            "truncated": timestep.truncated,
            "done": done,
            "info": timestep.info,
        }
        if self.single:
            return jax.tree.map(lambda x: x[0], outputs)
        info = dict(timestep.info)
        ended: dict[str, Any] = {
            name: info.pop(name) for name in ("final_obs", "final_info") if name in info
        }
        info = _with_masks(info, reported)
        if ended:
            ended["final_info"] = _with_masks(ended["final_info"], done)
            info |= _with_masks(ended, done)
        return outputs | {"info": info}


@cache
def programs_of(vector: VectorPixelEnv, single: bool) -> Programs:
    """Return the programs of environments, the same object for equal ones."""
    return Programs(vector, single)


def _with_offsets(state: EnvState, offsets: Array | None) -> EnvState:
    if offsets is None:
        return state
    return state.replace(sim=state.sim.replace(time_limit_offset=offsets))


def _with_masks(info: Mapping[str, Any], mask: Array) -> dict[str, Any]:
    """Add a mask ``_key`` for each ``key``, which says what environments it is about."""
    return {**info, **{f"_{name}": mask for name in info}}
