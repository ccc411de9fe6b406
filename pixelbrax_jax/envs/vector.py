"""A batch of pixel environments, and when their episodes begin anew."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.choices import check_choice, check_whole
from pixelbrax_jax.envs import observe
from pixelbrax_jax.envs.batch_last import batch_last
from pixelbrax_jax.envs.pixel_env import PixelEnv, check_key
from pixelbrax_jax.types import EnvParams, EnvState, Timestep

AUTORESET_MODES = ("next_step", "same_step", "disabled")

_BLOCK = 32
"""Environments that begin an episode together; their number is rounded up to a multiple."""

_CHUNK = 128
"""Largest chunk of environments whose physics a CPU steps together; see `_chunk_size`."""


class VectorPixelEnv:
    """``num_envs`` independent copies of a pixel environment that step together.

    States, observations, rewards and flags have a leading axis N. Environment i draws from
    ``fold_in(key, i)``, so that it is the same whatever N is.

    On a CPU physics are computed with the environments as last axis (``batch_last``), over which
    XLA's loops run then. The physics of more than 128 environments are stepped in equal chunks of
    64 to 128, whose intermediate results stay in the CPU's caches, if N divides into such: prefer
    multiples of 128. The chunks of a step are taken one after the other; the Gymnasium, TorchRL
    and Stable-Baselines3 environments take them at the same time, on all cores. To spread
    environments over several devices, take ``ShardedVectorEnv``.

    An ended episode is followed by a fresh one as ``autoreset_mode`` says, with Gymnasium's
    meanings:

    * ``"next_step"``: the step that ends an episode returns its last observation. The next
      step ignores that environment's action and returns the first observation of the next
      episode, with reward 0.
    * ``"same_step"``: the step that ends an episode returns the first observation of the
      next one. The last observation is in ``info["final_obs"]`` and what ``info`` had been in
      ``info["final_info"]``; both are meaningful where the episode ended.
    * ``"disabled"``: nothing begins by itself; call ``reset_where``. Until then the
      environment is stepped on, finite but without meaning.

    Attributes:
        env: the environment.
        num_envs: N.
        autoreset_mode: one of the three names.
    """

    def __init__(self, env: PixelEnv, num_envs: int, autoreset_mode: str = "next_step") -> None:
        """Checks the options.

        Args:
            env: the environment.
            num_envs: how many copies, at least 1.
            autoreset_mode: ``"next_step"``, ``"same_step"`` or ``"disabled"``.

        Raises:
            ValueError: an option is out of range; the message says what is allowed.
            MemoryError: observations would not fit into this machine's memory.
        """
        self.env = env
        self.num_envs = check_whole("num_envs", num_envs)
        self.autoreset_mode = check_choice("autoreset_mode", autoreset_mode, AUTORESET_MODES)
        env.check_memory(self.num_envs)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        """Begins episode 0 everywhere.

        Args:
            key: a typed PRNG key, from which environment i gets ``fold_in(key, i)``; or (N,) keys,
                one for each.
            params: what may be randomised, the same for all.

        Returns:
            The states and the first timesteps.

        Raises:
            TypeError: ``key`` is neither.
        """
        keys = self._env_keys(key)
        episode = jnp.zeros(self.num_envs, jnp.uint32)
        state = jax.vmap(self.env.begin, in_axes=(0, 0, None))(keys, episode, params)
        state = self._show(state, params, jnp.ones(self.num_envs, bool))
        return state, self._timestep(state, jnp.zeros(self.num_envs))

    @partial(jax.jit, static_argnums=0)
    def reset_where(
        self,
        state: EnvState,
        mask: jax.Array,
        params: EnvParams,
        key: jax.Array | None = None,
    ) -> tuple[EnvState, Timestep]:
        """Begins an episode in some environments and leaves the others as they are.

        Args:
            state: the present states.
            mask: (N,) bool, where to begin.
            params: what may be randomised.
            key: None begins each environment's next episode; else a key or (N,) keys as in
                ``reset``, of which episode 0 begins.

        Returns:
            The states and timesteps; reward 0 everywhere, and unmasked environments repeat their
            present observation and flags.

        Raises:
            TypeError: ``key`` is of another kind.
            ValueError: ``mask`` is not (N,) bool.
        """
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"mask must be bool of shape ({self.num_envs},), got {mask.dtype} of shape "
                f"{tuple(mask.shape)}."
            )
        episode = state.episode + 1
        if key is not None:
            keys = self._env_keys(key)
            state = state.replace(key=jnp.where(mask, keys, state.key))
            episode = jnp.zeros_like(state.episode)
        state = self._begin_where(state, mask, episode, params)
        return state, self._timestep(state, jnp.zeros(self.num_envs))

    @partial(jax.jit, static_argnums=0)
    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """Steps all environments, and begins episodes as ``autoreset_mode`` says.

        Args:
            state: the present states.
            action: (N, A) float, clipped to [-1, 1].
            params: what may be randomised.

        Returns:
            The next states and timesteps; ``info`` is that of ``PixelEnv.step``, and in mode
            ``"same_step"`` has ``final_obs`` and ``final_info`` besides.

        Raises:
            ValueError: ``action`` has another shape.
            TypeError: ``action`` is not floating point.
        """
        action = jnp.asarray(action)
        expected = (self.num_envs, self.env.action_size)
        if action.shape != expected:
            raise ValueError(f"action must have shape {expected}, got {tuple(action.shape)}.")
        moved, reward = self.advance(state.replace(frames=None), action, params)
        return self.finish(state.frames, state.done, moved, reward, params)

    def obs(self, state: EnvState) -> Any:
        """Observations of the states, with a leading axis N."""
        return jax.vmap(self.env.obs)(state)

    @staticmethod
    def keys_of(key: jax.Array, num_envs: int) -> jax.Array:
        """Keys of environments 0, 1, ...: (num_envs,) ``fold_in(key, i)``.

        Raises:
            TypeError: ``key`` is not a single typed key.
        """
        check_key(key)
        return jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(num_envs))

    @property
    def chunk_size(self) -> int:
        """Environments whose physics a CPU steps together."""
        return _chunk_size(self.num_envs)

    # The pieces of a step, for those who run the physics in parts.

    def advance(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, jax.Array]:
        """The states after their actions, with no episode begun and nothing drawn, and the rewards.

        Args:
            state: of all environments, or of some rows of them. ``frames`` should be None: physics
                does not read them, and they would be copied when a loop begins.
            action: (rows, A) float.
            params: what may be randomised.

        Returns:
            The states and (rows,) float32 rewards.
        """
        # Under jit both forms below share one trace of the physics, which takes seconds.
        one = jax.jit(self.env.advance)
        first = jax.vmap(one, in_axes=(0, 0, None))
        num_rows = action.shape[0]
        if num_rows == 1:
            return first(state, action, params)
        last = batch_last(one, in_axes=(0, 0, None))
        size = _chunk_size(num_rows)

        def advance_in_chunks(
            state: EnvState, action: jax.Array, params: EnvParams
        ) -> tuple[EnvState, jax.Array]:
            if size == num_rows:
                return last(state, action, params)

            # Some engines carry empty arrays, of which no dimension can be left to be found.
            def chunks(x: jax.Array) -> jax.Array:
                return x.reshape(num_rows // size, size, *x.shape[1:])

            states, actions = jax.tree.map(chunks, (state, action))

            def put(i: jax.Array, carry: tuple[EnvState, jax.Array]) -> tuple[EnvState, jax.Array]:
                chunk = jax.tree.map(lambda x: x[i], (carry[0], actions))
                moved = last(*chunk, params)
                return jax.tree.map(lambda x, new: x.at[i].set(new), carry, moved)

            # In place: the results of `jax.lax.map` would be cleared first and copied afterwards.
            carry = (states, jnp.zeros_like(states.episode_return))
            states, rewards = jax.lax.fori_loop(0, num_rows // size, put, carry)
            return jax.tree.map(lambda x: x.reshape(num_rows, *x.shape[2:]), (states, rewards))

        result: tuple[EnvState, jax.Array] = jax.lax.platform_dependent(
            state,
            action,
            params,
            cpu=advance_in_chunks,
            default=first,
        )
        return result

    def finish(
        self,
        frames: jax.Array,
        begins: jax.Array,
        moved: EnvState,
        reward: jax.Array,
        params: EnvParams,
    ) -> tuple[EnvState, Timestep]:
        """New episodes, pictures and timesteps: what ``step`` does after ``advance``.

        Args:
            frames: the frame stacks before the step.
            begins: (N,) bool, ``done`` of the states before the step.
            moved: the states of ``advance``, all N; their ``frames`` do not matter.
            reward: (N,) float32, of ``advance``.
            params: what may be randomised.

        Returns:
            What ``step`` returns.
        """
        state = moved.replace(frames=frames)
        if self.autoreset_mode == "next_step":
            state = self._restart(state, begins, state.episode + 1, params)
            state = self._show(state, params, begins)
            return state, self._timestep(state, jnp.where(begins, 0.0, reward))
        state = self._show(state, params, jnp.zeros(self.num_envs, bool))
        timestep = self._timestep(state, reward)
        if self.autoreset_mode == "disabled":
            return state, timestep
        state = self._begin_where(state, state.done, state.episode + 1, params)
        first = self._timestep(state, reward)
        info = {**first.info, "final_obs": timestep.obs, "final_info": timestep.info}
        return state, timestep.replace(obs=first.obs, info=info)

    def _env_keys(self, key: jax.Array) -> jax.Array:
        if getattr(key, "shape", ()) == ():
            return self.keys_of(key, self.num_envs)
        check_key(key, (self.num_envs,))
        return key

    def _timestep(self, state: EnvState, reward: jax.Array) -> Timestep:
        return jax.vmap(self.env.timestep)(state, reward)

    def _show(self, state: EnvState, params: EnvParams, first: jax.Array) -> EnvState:
        return jax.vmap(self.env.show, in_axes=(0, None, 0))(state, params, first)

    def _restart(
        self, state: EnvState, mask: jax.Array, episode: jax.Array, params: EnvParams
    ) -> EnvState:
        """``state`` with fresh episodes where ``mask``, whose frames are not drawn yet."""

        def begin(key: jax.Array, episode: jax.Array) -> EnvState:
            # The key stays, and the frames are not ready: neither travels through the loop.
            return self.env.begin(key, episode, params).replace(key=None, frames=None)

        kept = state.replace(key=None, frames=None)
        begun = _replace_rows(begin, (state.key, episode), mask, kept)
        return begun.replace(key=state.key, frames=state.frames)

    def _begin_where(
        self, state: EnvState, mask: jax.Array, episode: jax.Array, params: EnvParams
    ) -> EnvState:
        """``state`` with fresh episodes where ``mask``, drawn; the others keep their frames."""
        state = self._restart(state, mask, episode, params)
        if self.env.obs_mode == "state":
            return state
        blank = jnp.zeros((self.num_envs, self.env.height, self.env.width), jnp.uint32)
        shown = state.replace(key=None, frames=None)
        newest = _replace_rows(lambda row: self.env.draw(row, params), (shown,), mask, blank)
        first = jax.vmap(observe.push)(state.frames, newest, jnp.ones_like(mask))
        # Environments that go on keep their stack as it is: nothing new was drawn for them.
        return state.replace(frames=jnp.where(mask[:, None, None, None], first, state.frames))


def _chunk_size(num_envs: int) -> int:
    """The largest divisor of ``num_envs`` from half of ``_CHUNK`` to it; if there is none, all."""
    sizes = range(min(_CHUNK, num_envs), _CHUNK // 2 - 1, -1)
    return next((size for size in sizes if num_envs % size == 0), num_envs)


def _replace_rows(
    fn: Callable[..., Any], arguments: tuple[Any, ...], mask: jax.Array, rows: Any
) -> Any:
    """``rows`` with ``fn`` of the arguments' rows in place of those where ``mask``.

    The work is done in blocks and grows with the number of masked rows, not with N: most steps
    end no episode, and a select over the whole batch would pay for all of them.

    The loop carries which rows are left. With a counter in their place XLA took what the blocks
    have in common, such as physics at the first pose, out of the loop and into every step.
    """
    num_rows = mask.shape[0]
    block = min(_BLOCK, num_rows)

    def put(carry: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        left, rows = carry
        # Past the last one of those left: read as the last row, never written.
        index = jnp.nonzero(left, size=block, fill_value=num_rows)[0]
        inputs = jax.tree.map(lambda x: jnp.take(x, index, axis=0, mode="clip"), arguments)
        outputs = jax.vmap(fn)(*inputs)
        rows = jax.tree.map(lambda x, new: x.at[index].set(new, mode="drop"), rows, outputs)
        return left.at[index].set(False, mode="drop"), rows

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), put, (mask, rows))[1]
