"""A replay on the device that stores every frame once, and batches of n-step transitions."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.rollout import Rollout
from pixelbrax_jax.agents.train_state import along_envs, without_envs


class Batch(NamedTuple):
    """B transitions of up to n steps.

    Attributes:
        pixels, next_pixels: (B, H, W, 3 K) uint8, before the first and after the last step.
        action: (B, A) float32, the action of the first step.
        reward: (B,) float32, the discounted sum of the steps' rewards.
        discount: (B,) float32, the factor of the value of ``next_pixels``: ``gamma`` to the power
            of the number of steps, or 0 after a termination.
        weight: (B,) float32, 0 for a step that reset the episode, else 1.
    """

    pixels: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    next_pixels: jax.Array
    weight: jax.Array

    def mean(self, x: jax.Array) -> jax.Array:
        """Return the () mean of (B,) values of the samples with weight."""
        return jnp.sum(x * self.weight) / jnp.maximum(jnp.sum(self.weight), 1.0)


class Replay(struct.PyTreeNode):
    """The latest C steps of each of N environments; step t is in slot t modulo C.

    Attributes:
        frame: (N, C, H, W, 3) uint8, the newest frame of the observation before the step, or what
            ``Frames.pixels`` has.
        action: (N, C, A) float32, clipped to [-1, 1].
        reward: (N, C) float32.
        terminated, truncated: (N, C) bool.
        valid: (N, C) bool, False where the step reset the episode and ignored the action.
        count: () int32, steps of each environment so far.
    """

    frame: jax.Array = along_envs(0)
    action: jax.Array = along_envs(0)
    reward: jax.Array = along_envs(0)
    terminated: jax.Array = along_envs(0)
    truncated: jax.Array = along_envs(0)
    valid: jax.Array = along_envs(0)
    count: jax.Array = without_envs()

    @classmethod
    def empty(cls, num_envs: int, slots: int, frame: Any, action_size: int) -> Replay:
        """Return a replay without steps; ``frame`` is the ``jax.ShapeDtypeStruct`` of a frame."""
        shape = (num_envs, slots)
        return cls(
            frame=jnp.zeros((*shape, *frame.shape), frame.dtype),
            action=jnp.zeros((*shape, action_size)),
            reward=jnp.zeros(shape),
            terminated=jnp.zeros(shape, bool),
            truncated=jnp.zeros(shape, bool),
            valid=jnp.zeros(shape, bool),
            count=jnp.int32(0),
        )

    @property
    def slots(self) -> int:
        """C, the steps of each environment that fit."""
        return self.reward.shape[1]

    @property
    def size(self) -> jax.Array:
        """() int32, the stored steps of all environments."""
        return jnp.minimum(self.count, self.slots) * self.reward.shape[0]

    def add(self, rollout: Rollout) -> Replay:
        """Replace the oldest steps by a rollout's; it never wraps around, because T divides C."""
        first = self.count % self.slots

        def put(rows: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(rows, jnp.moveaxis(new, 0, 1), first, 1)

        num_steps = rollout.reward.shape[0]
        return Replay(
            frame=put(self.frame, rollout.frames.pixels[-num_steps:]),
            action=put(self.action, rollout.choice),
            reward=put(self.reward, rollout.reward),
            terminated=put(self.terminated, rollout.terminated),
            truncated=put(self.truncated, rollout.truncated),
            valid=put(self.valid, rollout.valid),
            count=self.count + num_steps,
        )

    def sample(
        self, key: jax.Array, batch_size: int, stack: int, n_step: int, gamma: float
    ) -> Batch:
        """Sample transitions with K - 1 steps before and n after, uniformly and with replacement.

        Each of gcd(N, B) groups of environments gives B / gcd(N, B): devices share a batch equally.
        """
        num_envs = self.reward.shape[0]
        groups = math.gcd(num_envs, batch_size)
        env_key, time_key = jax.random.split(key)
        shape = (groups, batch_size // groups)
        env = jax.random.randint(env_key, shape, 0, num_envs // groups)
        oldest = jnp.maximum(self.count - self.slots, 0)
        time = jax.random.randint(time_key, shape, oldest + stack - 1, self.count - n_step)
        return self.transitions(env, time, stack, n_step, gamma)

    def transitions(
        self, env: jax.Array, time: jax.Array, stack: int, n_step: int, gamma: float
    ) -> Batch:
        """Return the transitions from (G, B / G) int32 times, ``env`` counted in each group."""
        groups = env.shape[0]

        def rows(values: jax.Array, time: jax.Array) -> jax.Array:
            """Map (N, C, ...) values and (G, B / G, M) times to (B, M, ...)."""
            grouped = values.reshape(groups, -1, *values.shape[2:])
            index = env[..., None] * self.slots + time % self.slots
            picked = jax.vmap(lambda values, index: values[index])(grouped, index)
            return picked.reshape(env.size, *picked.shape[2:])

        def stacked(time: jax.Array) -> jax.Array:
            """Map (G, B / G) times to (B, H, W, 3 K) pixels; a first frame repeats."""
            before = time[..., None] - jnp.arange(1, stack)
            age = jnp.cumprod(rows(self.valid, before), -1).sum(-1).reshape(*time.shape, 1)
            back = jnp.minimum(jnp.arange(stack - 1, -1, -1), age)
            frames = jnp.moveaxis(rows(self.frame, time[..., None] - back), 1, -2)
            return frames.reshape(*frames.shape[:-2], -1)

        steps = time[..., None] + jnp.arange(n_step)
        terminated, truncated = rows(self.terminated, steps), rows(self.truncated, steps)
        reward, discount, length = n_step_return(
            rows(self.reward, steps), terminated, truncated, gamma
        )
        now = time[..., None]
        return Batch(
            pixels=stacked(time),
            action=rows(self.action, now)[:, 0],
            reward=reward,
            discount=discount,
            next_pixels=stacked(time + length.reshape(time.shape)),
            weight=rows(self.valid, now)[:, 0].astype(jnp.float32),
        )


def n_step_return(
    reward: jax.Array, terminated: jax.Array, truncated: jax.Array, gamma: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the (B,) rewards, discounts and int32 lengths of (B, n) steps, as in ``Batch``.

    Steps after the end of an episode do not count. At a truncation the value of the last
    observation counts.
    """
    ended = terminated | truncated
    before = jnp.cumsum(ended, -1) - ended
    counts = before == 0
    powers = gamma ** jnp.arange(reward.shape[-1], dtype=jnp.float32)
    length = counts.sum(-1, dtype=jnp.int32)
    stops = jnp.any(counts & terminated, -1)
    discount = jnp.where(stops, 0.0, jnp.float32(gamma) ** length)
    return jnp.sum(jnp.where(counts, powers * reward, 0.0), -1), discount, length
