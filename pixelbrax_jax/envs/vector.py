"""Batches of pixel environments and their autoreset modes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax._platform.batches import draw_rows, step_rows
from pixelbrax_jax._platform.resets import replace_rows, reset_rows
from pixelbrax_jax.envs.arguments import check_action, check_key
from pixelbrax_jax.envs.param_rows import ParamRows, split_params
from pixelbrax_jax.envs.pixel_env import PixelEnv, push_each
from pixelbrax_jax.flags import under_environment_flags
from pixelbrax_jax.types import EnvParams, EnvState, SimState, Timestep
from pixelbrax_jax.validation import check_choice, check_positive_int

AUTORESET_MODES = ("next_step", "same_step", "disabled")


@dataclass(frozen=True)
class VectorPixelEnv:
    """``num_envs`` independent copies of a pixel environment that step together.

    States, observations, rewards and flags have a leading axis N. Environment i uses the key
    ``fold_in(key, i)``, so it does not depend on N.

    A CPU steps the physics of more than 128 environments in equal chunks of 64 to 128 if N is
    divisible so: prefer multiples of 128. ``ShardedVectorEnv`` uses several devices.

    Arrays of ``EnvParams`` may have a leading axis N, for a camera, colors, lights, clips or time
    limit per environment. All others are shared.

    ``autoreset_mode`` has Gymnasium's meanings:

    * ``"next_step"``: the step that ends an episode returns its last observation. The next step
      ignores that environment's action and returns the first observation of the next episode, with
      reward 0.
    * ``"same_step"``: the step that ends an episode returns the first observation of the next one.
      ``info["final_obs"]`` and ``info["final_info"]`` have the last observation and info; they are
      meaningful only where an episode ended.
    * ``"disabled"``: nothing resets by itself; call ``reset_where``. Until then the environment
      continues with finite but meaningless values.

    Attributes:
        env: the environment.
        num_envs: N, at least 1.
        autoreset_mode: one of the three names.

    Raises:
        ValueError: a field is out of range; the message says what is allowed.
        MemoryError: observations do not fit into this machine's memory.
    """

    env: PixelEnv
    num_envs: int
    autoreset_mode: str = "next_step"

    def __post_init__(self) -> None:
        object.__setattr__(self, "num_envs", check_positive_int("num_envs", self.num_envs))
        check_choice("autoreset_mode", self.autoreset_mode, AUTORESET_MODES)
        self.env.check_memory(self.num_envs)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def reset(self, key: jax.Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        """Reset all environments to episode 0; return the states and the first timesteps.

        Args:
            key: a typed PRNG key, of which environment i gets ``fold_in(key, i)``; or (N,) keys.
            params: the parameters; each array is shared or has a leading axis N.

        Raises:
            TypeError: ``key`` is neither.
            ValueError: an array of ``params`` has another shape; the message has its name.
        """
        keys, rows = self.env_keys(key, self.num_envs), split_params(params, self.num_envs)
        reset = jax.vmap(rows.of_row(self.env.reset_sim))
        sim = reset(keys, jnp.zeros(self.num_envs, jnp.uint32), rows.own)
        blank = self.env.blank_frames()
        frames = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.num_envs, *x.shape)), blank)
        frames = self._push_frames(frames, sim, rows, jnp.ones(self.num_envs, bool))
        state = EnvState(sim=sim, frames=frames, key=keys)
        return state, self._timestep(state, jnp.zeros(self.num_envs), rows)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def reset_where(
        self,
        state: EnvState,
        mask: jax.Array,
        params: EnvParams,
        key: jax.Array | None = None,
    ) -> tuple[EnvState, Timestep]:
        """Reset the environments where ``mask`` (N,) bool is set, and leave the others unchanged.

        Without a ``key`` they start their next episode, with a key or (N,) keys episode 0.

        Returns:
            The states and timesteps, with reward 0; others repeat their observation and flags.

        Raises:
            TypeError: ``key`` has another type.
            ValueError: ``mask`` is not (N,) bool, or an array of ``params`` has another shape.
        """
        mask = jnp.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"mask must be bool of shape ({self.num_envs},), got {mask.dtype} of shape "
                f"{tuple(mask.shape)}."
            )
        episode, rows = state.sim.episode + 1, split_params(params, self.num_envs)
        if key is not None:
            keys = self.env_keys(key, self.num_envs)
            state = state.replace(key=jnp.where(mask, keys, state.key))
            episode = jnp.zeros_like(episode)
        state = self._reset_and_draw(state, mask, episode, rows)
        return state, self._timestep(state, jnp.zeros(self.num_envs), rows)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """Step all environments under actions (N, A) float, clipped to [-1, 1], and reset some.

        Returns:
            The next states and timesteps; ``info`` is that of ``PixelEnv.step`` and of the mode.

        Raises:
            ValueError: ``action`` or an array of ``params`` has another shape.
            TypeError: ``action`` is not floating point.
        """
        action = check_action(action, (self.num_envs, self.env.action_size))
        ended, rows = state.done, split_params(params, self.num_envs)
        # JAX keeps `advance` in a cache, and would keep values that it closes over.
        layout = replace(rows, own=(), shared=())

        def advance(sim: SimState, own: Any, shared: Any) -> tuple[SimState, jax.Array]:
            key, action, own_params = own
            return self.env.advance(sim, key, action, layout.join(own_params, shared))

        own = state.key, action, rows.own
        sim, reward = step_rows(advance, state.sim, own, rows.shared)
        next_step = self.autoreset_mode == "next_step"
        if next_step:
            sim = self._reset_rows(state.replace(sim=sim), ended, sim.episode + 1, rows)
        is_first = ended if next_step else jnp.zeros(self.num_envs, bool)
        frames = self._push_frames(state.frames, sim, rows, is_first)
        state = state.replace(sim=sim, frames=frames)
        reward = jnp.where(ended, 0.0, reward) if next_step else reward
        timestep = self._timestep(state, reward, rows)
        if self.autoreset_mode != "same_step":
            return state, timestep
        state = self._reset_and_draw(state, state.done, state.sim.episode + 1, rows)
        first = self._timestep(state, reward, rows)
        info = {**first.info, "final_obs": timestep.obs, "final_info": timestep.info}
        return state, timestep.replace(obs=first.obs, info=info)

    def obs(self, state: EnvState) -> Any:
        """Return the observations of the states, with a leading axis N."""
        return jax.vmap(self.env.obs)(state)

    @staticmethod
    def env_keys(key: jax.Array, num_envs: int) -> jax.Array:
        """Return (num_envs,) keys as they are, or ``fold_in(key, i)`` of a single key."""
        if getattr(key, "shape", ()) != ():
            check_key(key, (num_envs,))
            return key
        check_key(key)
        return jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(num_envs))

    def _timestep(self, state: EnvState, reward: jax.Array, params: ParamRows) -> Timestep:
        return jax.vmap(params.of_row(self.env.timestep))(state, reward, params.own)

    def _push_frames(
        self, frames: Any, sim: SimState, params: ParamRows, is_first: jax.Array
    ) -> Any:
        if not self.env.images:
            return frames
        env, rows = self.env, (sim, params.own)
        draw, look = params.of_row(env.draw_obs), params.join(params.own).look
        # Reflections and the sky's texture are images of their own.
        if look.reflectance is not None or look.sky_texture is not None:
            images = jax.tree.leaves(env.drawn_spec)
            rays = max(image.size for image in images) * env.samples
            newest = draw_rows(draw, rows, rays)
        else:
            newest = jax.vmap(draw)(*rows)
        return jax.vmap(push_each)(frames, newest, is_first)

    def _reset_rows(
        self, state: EnvState, mask: jax.Array, episode: jax.Array, params: ParamRows
    ) -> SimState:
        reset, rows = params.of_row(self.env.reset_sim), (state.key, episode, params.own)
        return reset_rows(reset, rows, mask, state.sim)

    def _reset_and_draw(
        self, state: EnvState, mask: jax.Array, episode: jax.Array, params: ParamRows
    ) -> EnvState:
        """Return the states, reset and rendered where ``mask`` is set; others keep their frames."""
        sim = self._reset_rows(state, mask, episode, params)
        state = state.replace(sim=sim)
        if not self.env.images:
            return state
        blank = jax.tree.map(
            lambda x: jnp.zeros((self.num_envs, *x.shape), x.dtype), self.env.drawn_spec
        )
        newest = replace_rows(params.of_row(self.env.draw_obs), (sim, params.own), mask, blank)
        first = jax.vmap(push_each)(state.frames, newest, jnp.ones_like(mask))
        # Other environments keep their stacks, because nothing was rendered for them.
        where = mask[:, None, None, None]
        frames = jax.tree.map(lambda new, old: jnp.where(where, new, old), first, state.frames)
        return state.replace(frames=frames)
