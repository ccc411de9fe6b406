"""The compiled programs behind an environment that keeps its state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_gym.threads import call_on_threads
from pixelbrax_jax import VectorPixelEnv
from pixelbrax_jax.compilation import compiler_options
from pixelbrax_jax.types import EnvParams, EnvState, Timestep


class Programs:
    """The compiled programs of one set of options; all environments with them share these.

    States, or their frames, are donated: XLA overwrites them in place. Outputs are not, which is
    why they can be given away.
    """

    def __init__(self, vector: VectorPixelEnv, single: bool) -> None:
        self.vector, self.single = vector, single
        options = compiler_options()
        self.reset = jax.jit(self._reset, compiler_options=options)
        self.reset_where = jax.jit(self._reset_where, donate_argnums=0, compiler_options=options)
        self.step_where = jax.jit(self._step_where, donate_argnums=0, compiler_options=options)
        self.step_at_once = jax.jit(self._step, donate_argnums=0, compiler_options=options)
        self.advance = jax.jit(self._advance, compiler_options=options)
        self.finish = jax.jit(self._finish, donate_argnums=0, compiler_options=options)
        self.compiled_advance: dict[Any, Callable[..., tuple[EnvState, jax.Array]]] = {}
        on_cpu = jax.default_backend() == "cpu"
        self._chunk_size = vector.chunk_size if on_cpu else vector.num_envs

    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, dict[str, Any]]:
        """A step; on a CPU chunks of physics run at the same time, each on a core.

        They are the chunks of ``VectorPixelEnv``, whatever the number of cores, so that this
        number does not decide how XLA rounds.
        """
        stepped: tuple[EnvState, dict[str, Any]]
        if self._chunk_size == self.vector.num_envs:
            stepped = self.step_at_once(state, action, params)
            return stepped
        before = state.replace(frames=None)
        starts = np.arange(0, self.vector.num_envs, self._chunk_size, dtype=np.int32)
        calls = [(before, action, params, start) for start in starts]
        # Compiled here: threads do not know the contexts that the caller may be in.
        leaves, structure = jax.tree.flatten(params)
        kind = (frozenset(state.done.devices()), structure, *map(jax.typeof, leaves))
        if kind not in self.compiled_advance:
            self.compiled_advance[kind] = self.advance.lower(*calls[0]).compile()
        chunks = call_on_threads(self.compiled_advance[kind], calls)
        stepped = self.finish(state.frames, state.done, chunks, params)
        return stepped

    def _advance(
        self, state: EnvState, action: jax.Array, params: EnvParams, start: jax.Array
    ) -> tuple[EnvState, jax.Array]:
        def rows(x: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice_in_dim(x, start, self._chunk_size)

        state, action = jax.tree.map(rows, (state, action))
        return self.vector.advance(state, action, params)

    def _finish(
        self,
        frames: jax.Array,
        begins: jax.Array,
        chunks: list[tuple[EnvState, jax.Array]],
        params: EnvParams,
    ) -> tuple[EnvState, dict[str, Any]]:
        moved, reward = jax.tree.map(lambda *rows: jnp.concatenate(rows), *chunks)
        state, timestep = self.vector.finish(frames, begins, moved, reward, params)
        return state, self._outputs(timestep, jnp.ones(self.vector.num_envs, bool))

    def _reset(self, seeds: jax.Array, params: EnvParams) -> tuple[EnvState, dict[str, Any]]:
        state, timestep = self.vector.reset(jax.vmap(jax.random.key)(seeds), params)
        return state, self._outputs(timestep, jnp.ones(self.vector.num_envs, bool))

    def _reset_where(
        self,
        state: EnvState,
        mask: jax.Array,
        reported: jax.Array,
        params: EnvParams,
        seeds: jax.Array | None,
    ) -> tuple[EnvState, dict[str, Any]]:
        key = None if seeds is None else jax.vmap(jax.random.key)(seeds)
        state, timestep = self.vector.reset_where(state, mask, params, key)
        return state, self._outputs(timestep, reported)

    def _step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, dict[str, Any]]:
        if self.single:
            action = action[None]
        state, timestep = self.vector.step(state, action, params)
        return state, self._outputs(timestep, jnp.ones(self.vector.num_envs, bool))

    def _step_where(
        self, state: EnvState, mask: jax.Array, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, dict[str, Any]]:
        stepped, outputs = self._step(state, action, params)

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)

        state = jax.tree.map(choose, stepped, state)
        obs = jax.vmap(self.vector.env.obs)(state)
        return state, outputs | {"obs": obs, "done": outputs["done"] & mask}

    def _outputs(self, timestep: Timestep, present: jax.Array) -> dict[str, Any]:
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
        info = _with_masks(info, present)
        if ended:
            ended["final_info"] = _with_masks(ended["final_info"], done)
            info |= _with_masks(ended, done)
        return outputs | {"info": info}


def _with_masks(info: Mapping[str, Any], mask: jax.Array) -> dict[str, Any]:
    """Gymnasium's convention: beside ``key``, ``_key`` says which environments it is about."""
    return {**info, **{f"_{name}": mask for name in info}}
