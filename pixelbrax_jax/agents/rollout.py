"""Collect rollouts that store every frame once, and rebuild the stacked observations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.train_state import Metrics, along_envs
from pixelbrax_jax.envs.sharded import ShardedVectorEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.types import EnvParams, EnvState

Choose = Callable[[jax.Array, jax.Array | None, jax.Array], tuple[jax.Array, Any]]
"""``choose(pixels, state, key) -> (action, choice)``: actions for N observations, and a tree of
(N, ...) arrays that learning needs."""


Environments = VectorPixelEnv | ShardedVectorEnv
"""N environments that reset in mode ``"next_step"``; others need the same methods and a hash."""


class Frames(struct.PyTreeNode):
    """Observations of T steps of N environments.

    Attributes:
        pixels: (K - 1 + T, N, H, W, 3) uint8 single frames; the first K - 1 precede the rollout.
            Depths are (..., 1) float32; of C cameras there are C times the channels.
        age: (T, N) int32, earlier frames of the same episode, at most K - 1.
        shift: (N, 2) int32, shift of the observations in pixels down and right.
        state: (T, N, S) float32, the simulator's state; None unless a critic sees it.
    """

    pixels: jax.Array = along_envs(1)
    age: jax.Array = along_envs(1)
    shift: jax.Array = along_envs(0)
    state: jax.Array | None = along_envs(1)


class Rollout(struct.PyTreeNode):
    """T steps of N environments.

    Attributes:
        choice: second output of ``choose``, (T, N, ...).
        last_choice: the same for the observation after the last step, (N, ...).
        reward: (T, N) float32.
        terminated, truncated: (T, N) bool.
        valid: (T, N) bool, False where the step reset the episode and ignored the action.
        episode_return: (T, N) float32, sum of the episode's rewards so far.
        episode_length: (T, N) int32, control steps of the episode so far.
    """

    frames: Frames
    choice: Any
    last_choice: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    valid: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array

    @property
    def done(self) -> jax.Array:
        """(T, N) bool, whether an episode ended."""
        return self.terminated | self.truncated

    def episode_metrics(self) -> Metrics:
        """Return count, sum of returns and sum of lengths of the episodes that ended."""
        done = self.done
        return {
            "episode/count": jnp.sum(done, dtype=jnp.int32),
            "episode/return_sum": jnp.sum(jnp.where(done, self.episode_return, 0.0)),
            "episode/length_sum": jnp.sum(jnp.where(done, self.episode_length, 0)),
        }


def collect(
    envs: Environments,
    env_state: EnvState,
    env_params: EnvParams,
    choose: Choose,
    key: jax.Array,
    num_steps: int,
    random_shift: int = 0,
) -> tuple[EnvState, Rollout]:
    """Collect ``num_steps`` steps, and shift observations by up to ``random_shift`` pixels."""
    num_envs = envs.num_envs
    shift_key = jax.random.fold_in(key, num_steps + 1)
    shift = jax.random.randint(shift_key, (num_envs, 2), -random_shift, random_shift + 1)
    first, _ = split_obs(envs.obs(env_state))
    stack = envs.env.frame_stack
    channels = first.shape[-1] // stack
    before = jnp.moveaxis(first.reshape(*first.shape[:-1], stack, channels), -2, 0)[:-1]

    def choose_at(env_state: EnvState, number: Any) -> tuple[Any, ...]:
        pixels, state = split_obs(envs.obs(env_state))
        seen = shifted(pixels, shift, random_shift)
        return pixels, state, *choose(seen, state, jax.random.fold_in(key, number))

    def step(carry: tuple[EnvState, jax.Array], number: jax.Array) -> tuple[Any, Any]:
        env_state, age = carry
        pixels, state, action, choice = choose_at(env_state, number)
        begins = env_state.done
        env_state, timestep = envs.step(env_state, action, env_params)
        outcome = (
            timestep.reward,
            timestep.terminated,
            timestep.truncated,
            ~begins,
            timestep.info["episode_return"],
            timestep.info["episode_length"],
        )
        kept = (pixels[..., -channels:], age, state)
        age = jnp.where(begins, 0, jnp.minimum(age + 1, stack - 1))
        return (env_state, age), (kept, choice, outcome)

    # The first stack is complete: an episode that has just been reset repeats its first frame.
    start = (env_state, jnp.full(num_envs, stack - 1))
    (env_state, _), (kept, choice, outcome) = jax.lax.scan(step, start, jnp.arange(num_steps))
    newest, age, state = kept
    *_, last_choice = choose_at(env_state, num_steps)
    frames = Frames(pixels=jnp.concatenate([before, newest]), age=age, shift=shift, state=state)
    return env_state, Rollout(frames, choice, last_choice, *outcome)


def observations(frames: Frames, times: jax.Array, random_shift: int = 0) -> jax.Array:
    """Rebuild the (N B, H, W, 3 K) pixels at (B, N) int32 times, ordered by environment."""
    stack = frames.pixels.shape[0] - frames.age.shape[0] + 1
    age = jnp.take_along_axis(frames.age, times, axis=0)
    back = jnp.minimum(jnp.arange(stack - 1, -1, -1), age[..., None])
    index = times[..., None] + stack - 1 - back
    picked = jax.vmap(lambda pixels, index: pixels[index], in_axes=1)(frames.pixels, index)
    stacked = jnp.moveaxis(picked, 2, -2)
    stacked = stacked.reshape(*stacked.shape[:-2], -1)
    if random_shift:
        of_times = jax.vmap(shifted, in_axes=(1, None, None), out_axes=1)
        stacked = of_times(stacked, frames.shift, random_shift)
    return stacked.reshape(-1, *stacked.shape[2:])


def at_times(rows: jax.Array, times: jax.Array) -> jax.Array:
    """Map (T, N, ...) rows and (B, N) int32 times to (N B, ...), ordered by environment."""
    picked = jax.vmap(lambda rows, index: rows[index], in_axes=1)(rows, times)
    return picked.reshape(-1, *rows.shape[2:])


def split_obs(obs: Any) -> tuple[Any, Any]:
    """Split an observation or its spec into its only image and state; a missing part is None."""
    if isinstance(obs, dict):
        images = [part for name, part in obs.items() if name != "state"]
        return images[0] if len(images) == 1 else None, obs.get("state")
    return obs, None


def shifted(pixels: jax.Array, shift: jax.Array, at_most: int) -> jax.Array:
    """Shift (N, H, W, C) images by (N, 2) pixels, with repeated edges (arXiv 2004.13649)."""
    if not at_most:
        return pixels
    height, width = pixels.shape[1:3]
    rows = jnp.clip(jnp.arange(height)[None] - shift[:, :1], 0, height - 1)
    columns = jnp.clip(jnp.arange(width)[None] - shift[:, 1:], 0, width - 1)
    return jax.vmap(lambda image, r, c: image[r][:, c])(pixels, rows, columns)
