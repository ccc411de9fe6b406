"""Returns, advantages, and the scale of rewards."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.env_axis import along_envs, without_envs


def gae(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Return generalised advantage estimates (Schulman et al., arXiv 1506.02438).

    ``delta_t = r_t + gamma (1 - d_t) V(o_{t+1}) - V(o_t)`` and
    ``A_t = delta_t + gamma lambda (1 - d_t) (1 - u_t) A_{t+1}``, where d is termination and u is
    truncation. ``o_{t+1}`` is the observation that the step returned, also of the step that ended
    the episode: a time limit does not make the future worthless.

    Args:
        reward: (T, N) float32.
        value: (T, N) float32, V(o_t).
        last_value: (N,) float32, V(o_T).
        terminated: (T, N) bool.
        truncated: (T, N) bool.
        gamma: discount.
        gae_lambda: lambda.

    Returns:
        Advantages and returns ``A_t + V(o_t)``, (T, N) float32 each. At a step that only begins
        an episode both are without meaning.
    """
    following = jnp.concatenate([value[1:], last_value[None]])
    delta = reward + gamma * jnp.where(terminated, 0.0, following) - value

    def backwards(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        delta, over = now
        advantage = delta + gamma * gae_lambda * jnp.where(over, 0.0, later)
        return advantage, advantage

    over = terminated | truncated
    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(last_value), (delta, over), reverse=True)
    return advantage, advantage + value


class RewardScaler(struct.PyTreeNode):
    """Divides rewards by the standard deviation of discounted returns seen so far.

    ``G_t = gamma G_{t-1} + r_t``, from 0 in every episode; rewards become
    ``clip(r / sqrt(var(G) + 1e-8), -10, 10)``, as in OpenAI's baselines and PPG
    (arXiv 2009.04416).

    Attributes:
        discounted: (N,) float32, G of each environment.
        count: () float32, number of returns seen; to 24 bits.
        mean: () float32.
        square: () float32, mean squared deviation from the mean.
    """

    discounted: jax.Array = along_envs(0)
    count: jax.Array = without_envs()
    mean: jax.Array = without_envs()
    square: jax.Array = without_envs()

    @classmethod
    def start(cls, num_envs: int) -> RewardScaler:
        """Return a scaler that has seen nothing."""
        return cls(
            discounted=jnp.zeros(num_envs),
            count=jnp.float32(0.0),
            mean=jnp.float32(0.0),
            square=jnp.float32(0.0),
        )

    @property
    def scale(self) -> jax.Array:
        """() float32, what a reward is divided by."""
        return jnp.sqrt(self.square + 1e-8)

    def __call__(
        self, reward: jax.Array, done: jax.Array, valid: jax.Array, gamma: float
    ) -> tuple[RewardScaler, jax.Array]:
        """Learn from a rollout, then scale it.

        Args:
            reward: (T, N) float32.
            done: (T, N) bool, the step ended an episode.
            valid: (T, N) bool, the step did not merely begin one.
            gamma: discount.

        Returns:
            The scaler that has seen the rollout, and its rewards, scaled.
        """

        def forwards(before: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            reward, done = now
            discounted = gamma * before + reward
            return jnp.where(done, 0.0, discounted), discounted

        after, seen = jax.lax.scan(forwards, self.discounted, (reward, done))
        number = jnp.sum(valid, dtype=jnp.float32)
        weight = valid / jnp.maximum(number, 1)
        mean = jnp.sum(weight * seen)
        square = jnp.sum(weight * (seen - mean) ** 2)
        # Chan et al.'s union of two samples, in fractions of their sizes.
        count = self.count + number
        fraction = number / jnp.maximum(count, 1.0)
        shift = mean - self.mean
        scaler = RewardScaler(
            discounted=after,
            count=count,
            mean=self.mean + fraction * shift,
            square=(1 - fraction) * self.square
            + fraction * square
            + fraction * (1 - fraction) * shift**2,
        )
        return scaler, jnp.clip(reward / scaler.scale, -10.0, 10.0)
