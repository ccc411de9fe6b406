"""The compiled programs behind an environment that keeps its state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import PixelEnv, VectorPixelEnv, compilation
from pixelbrax_jax.types import EnvParams, EnvState, Timestep

Array = jax.Array | np.ndarray
Stepped = tuple[EnvState, dict[str, Any]]


def _env(programs: Programs) -> PixelEnv:
    return programs.vector.env


@dataclass(frozen=True)
class Programs:
    """The compiled programs of one set of options, which all environments with equal ones share.

    States are donated: XLA overwrites them in place. Outputs are not, which is why they can be
    given away.

    Attributes:
        vector: the environments.
        single: whether actions and outputs lack the leading axis; there is one environment then.
    """

    vector: VectorPixelEnv
    single: bool

    @compilation.jit(_env, static_argnums=0)
    def reset(self, seeds: Array, params: EnvParams) -> Stepped:
        """Reset all environments to episode 0 of their (N,) uint32 seeds."""
        state, timestep = self.vector.reset(jax.vmap(jax.random.key)(seeds), params)
        return state, self._outputs(timestep, jnp.ones(self.vector.num_envs, bool))

    @compilation.jit(_env, static_argnums=0, donate_argnums=1)
    def reset_where(
        self,
        state: EnvState,
        mask: Array,
        reported: Array,
        params: EnvParams,
        seeds: Array | None,
    ) -> Stepped:
        """Reset some environments; infos are about those that ``reported`` names, (N,) bool."""
        key = None if seeds is None else jax.vmap(jax.random.key)(seeds)
        state, timestep = self.vector.reset_where(state, mask, params, key)
        return state, self._outputs(timestep, reported)

    @compilation.jit(_env, static_argnums=0, donate_argnums=1)
    def step(self, state: EnvState, action: Array, params: EnvParams) -> Stepped:
        """Step all environments."""
        return self._step(state, action, params)

    @compilation.jit(_env, static_argnums=0, donate_argnums=1)
    def step_where(self, state: EnvState, mask: Array, action: Array, params: EnvParams) -> Stepped:
        """Step some environments; the others repeat their observation, with ``done`` False."""
        stepped, outputs = self._step(state, action, params)

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)

        state = jax.tree.map(choose, stepped, state)
        obs = self.vector.obs(state)
        return state, outputs | {"obs": obs, "done": outputs["done"] & mask}

    def _step(self, state: EnvState, action: Array, params: EnvParams) -> Stepped:
        if self.single:
            action = action[None]
        state, timestep = self.vector.step(state, action, params)
        return state, self._outputs(timestep, jnp.ones(self.vector.num_envs, bool))

    def _outputs(self, timestep: Timestep, present: Array) -> dict[str, Any]:
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


def _with_masks(info: Mapping[str, Any], mask: Array) -> dict[str, Any]:
    """Add a mask ``_key`` for each ``key``, which says what environments it is about."""
    return {**info, **{f"_{name}": mask for name in info}}


@compilation.jit(lambda env: env, static_argnums=(0, 3, 4))
def draw_images(
    env: PixelEnv, state: EnvState, params: EnvParams, height: int, width: int
) -> jax.Array:
    """Draw the states of N environments, (N, height, width, 3) uint8."""
    draw = jax.vmap(lambda state: env.image(state, params, height, width))
    images: jax.Array = draw(state)
    return images
