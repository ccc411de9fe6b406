"""The terms that the algorithms' losses are made of, and their metrics."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.rollout import Rollout, at_times, observations

Metrics = dict[str, jax.Array]


class Batch(NamedTuple):
    """B samples of a rollout, environment by environment.

    Attributes:
        pixels: (B, H, W, 3 K) uint8.
        state: (B, S) float32, or None.
        unclipped_action: (B, A) float32.
        log_prob, value: (B,) float32, of the policy and value that played.
        advantage, returns: (B,) float32.
        weight: (B,) float32, 1 or, for steps that teach nothing, 0.
    """

    pixels: jax.Array
    state: jax.Array | None
    unclipped_action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    returns: jax.Array
    weight: jax.Array


def batch_at(
    config: TrainConfig,
    rollout: Rollout,
    advantage: jax.Array,
    returns: jax.Array,
    times: jax.Array,
) -> Batch:
    """Return the samples of some times, (B, N) int32."""
    frames = rollout.frames
    return Batch(
        pixels=observations(frames, times, config.random_shift),
        state=None if frames.state is None else at_times(frames.state, times),
        unclipped_action=at_times(rollout.unclipped_action, times),
        log_prob=at_times(rollout.log_prob, times),
        value=at_times(rollout.value, times),
        advantage=at_times(advantage, times),
        returns=at_times(returns, times),
        weight=at_times(rollout.valid, times).astype(jnp.float32),
    )


def mean(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Return () weighted mean; 0 where nothing has weight."""
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def normalized(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Return ``x`` with weighted mean 0 and standard deviation 1."""
    center = x - mean(x, weight)
    return center / (jnp.sqrt(mean(center**2, weight)) + 1e-8)


def policy_loss(
    policy: Normal, batch: Batch, config: TrainConfig, key: jax.Array
) -> tuple[jax.Array, Metrics]:
    """Return PPO's clipped objective and the entropy bonus (Schulman et al., arXiv 1707.06347).

    ``- mean min(rho A, clip(rho, 1 - eps, 1 + eps) A) - c_H H`` with the ratio
    ``rho = exp(log pi(a) - log pi_old(a))``.

    Args:
        policy: today's, of the batch's observations.
        batch: the samples.
        config: settings.
        key: for entropies that are estimated.
    """
    advantage = batch.advantage
    if config.normalize_advantage == "minibatch":
        advantage = normalized(advantage, batch.weight)
    log_ratio = policy.log_prob(batch.unclipped_action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip_coef, 1.0 + config.clip_coef)
    objective = mean(jnp.minimum(ratio * advantage, clipped * advantage), batch.weight)
    entropy = mean(policy.entropy(key), batch.weight)
    outside = jnp.abs(ratio - 1.0) > config.clip_coef
    return -objective - config.ent_coef * entropy, {
        "loss/policy": -objective,
        "policy/entropy": entropy,
        # Schulman's estimator, http://joschu.net/blog/kl-approx.html
        "policy/approx_kl": mean(ratio - 1.0 - log_ratio, batch.weight),
        "policy/clip_fraction": mean(outside, batch.weight),
    }


def value_loss(value: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """Return () half the mean squared error."""
    return 0.5 * mean((value - target) ** 2, weight)


def clipped_value_loss(value: jax.Array, batch: Batch, clip_coef: float) -> jax.Array:
    """Return () the larger of the errors of the value and of the value kept near what it was."""
    near = batch.value + jnp.clip(value - batch.value, -clip_coef, clip_coef)
    error = jnp.maximum((value - batch.returns) ** 2, (near - batch.returns) ** 2)
    return 0.5 * mean(error, batch.weight)


def policy_metrics(std: jax.Array) -> Metrics:
    """Return what is logged of a policy's standard deviations, (..., A)."""
    return {"policy/std_min": std.min(), "policy/std_mean": std.mean(), "policy/std_max": std.max()}
