"""Advantages, reward scaling and the losses of on-policy algorithms."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.config import OnPolicyConfig
from pixelbrax_jax.agents.train_state import Metrics, along_envs, without_envs


def gae(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Return advantages (Schulman et al., arXiv 1506.02438) and returns ``A_t + V(o_t)``, (T, N).

    ``delta_t = r_t + gamma (1 - d_t) V(o_{t+1}) - V(o_t)`` and
    ``A_t = delta_t + gamma lambda (1 - d_t) (1 - u_t) A_{t+1}`` with termination d and truncation
    u. ``o_{t+1}`` is the observation that the step returned, also at the end of an episode.
    ``last_value`` is (N,), the other arrays are (T, N). Results at a reset are meaningless.
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
    """Divides rewards by the running standard deviation of discounted returns.

    ``G_t = gamma G_{t-1} + r_t`` starts from 0 in every episode. Rewards become
    ``clip(r / sqrt(var(G) + 1e-8), -10, 10)``, as in OpenAI's baselines and PPG (arXiv 2009.04416).

    Attributes:
        discounted: (N,) float32, G of each environment.
        count, mean, square: () float32, number, mean and variance of the returns.
    """

    discounted: jax.Array = along_envs(0)
    count: jax.Array = without_envs()
    mean: jax.Array = without_envs()
    square: jax.Array = without_envs()

    @classmethod
    def start(cls, num_envs: int) -> RewardScaler:
        """Return a scaler without data."""
        zero = jnp.float32(0.0)
        return cls(discounted=jnp.zeros(num_envs), count=zero, mean=zero, square=zero)

    @property
    def scale(self) -> jax.Array:
        """() float32 divisor of rewards."""
        return jnp.sqrt(self.square + 1e-8)

    def __call__(
        self, reward: jax.Array, done: jax.Array, valid: jax.Array, gamma: float
    ) -> tuple[RewardScaler, jax.Array]:
        """Add the (T, N) arrays of a rollout; return the new scaler and the scaled rewards."""

        def forwards(before: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            reward, done = now
            discounted = gamma * before + reward
            return jnp.where(done, 0.0, discounted), discounted

        after, seen = jax.lax.scan(forwards, self.discounted, (reward, done))
        number = jnp.sum(valid, dtype=jnp.float32)
        weight = valid / jnp.maximum(number, 1)
        mean = jnp.sum(weight * seen)
        square = jnp.sum(weight * (seen - mean) ** 2)
        # Merges two samples by the formula of Chan et al., in fractions of their sizes.
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


class Batch(NamedTuple):
    """B samples of a rollout, ordered by environment.

    Attributes:
        pixels: (B, H, W, 3 K) uint8.
        state: (B, S) float32, or None.
        unclipped_action: (B, A) float32.
        log_prob, value: (B,) float32, from the networks that collected the rollout.
        advantage, returns: (B,) float32.
        weight: (B,) float32, 0 at an episode reset, else 1.
    """

    pixels: jax.Array
    state: jax.Array | None
    unclipped_action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    returns: jax.Array
    weight: jax.Array


def mean(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Return the () weighted mean, or 0 if all weights are 0."""
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def normalized(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Normalise ``x`` to weighted mean 0 and standard deviation 1."""
    center = x - mean(x, weight)
    return center / (jnp.sqrt(mean(center**2, weight)) + 1e-8)


def policy_loss(
    policy: Normal, batch: Batch, config: OnPolicyConfig, key: jax.Array
) -> tuple[jax.Array, Metrics]:
    """Return PPO's clipped loss with entropy bonus (Schulman et al., arXiv 1707.06347)."""
    advantage = batch.advantage
    if config.normalize_advantage == "minibatch":
        advantage = normalized(advantage, batch.weight)
    log_ratio = policy.log_prob(batch.unclipped_action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip_coef, 1.0 + config.clip_coef)
    objective = mean(jnp.minimum(ratio * advantage, clipped * advantage), batch.weight)
    entropy = mean(policy.entropy(key), batch.weight)
    outside = jnp.abs(ratio - 1.0) > config.clip_coef
    std = policy.std
    return -objective - config.ent_coef * entropy, {
        "loss/policy": -objective,
        "policy/entropy": entropy,
        # Schulman's estimator, http://joschu.net/blog/kl-approx.html
        "policy/approx_kl": mean(ratio - 1.0 - log_ratio, batch.weight),
        "policy/clip_fraction": mean(outside, batch.weight),
        "policy/std_min": std.min(),
        "policy/std_mean": std.mean(),
        "policy/std_max": std.max(),
    }


def value_loss(value: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """Return half the mean squared error, ()."""
    return 0.5 * mean((value - target) ** 2, weight)


def clipped_value_loss(value: jax.Array, batch: Batch, clip_coef: float) -> jax.Array:
    """Return the larger of the losses of the value and of the value clipped to the old one, ()."""
    near = batch.value + jnp.clip(value - batch.value, -clip_coef, clip_coef)
    error = jnp.maximum((value - batch.returns) ** 2, (near - batch.returns) ** 2)
    return 0.5 * mean(error, batch.weight)
