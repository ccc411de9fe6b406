"""A rollout with what learning needs of it: advantages, returns and metrics."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.on_policy.losses import Metrics, mean, normalized
from pixelbrax_jax.agents.on_policy.returns import gae
from pixelbrax_jax.agents.on_policy.rollout import Decision, Environments, Rollout, collect
from pixelbrax_jax.agents.train_state import TrainState, action_key
from pixelbrax_jax.types import EnvParams


class Experience(NamedTuple):
    """A rollout of T steps of N environments, and what follows from it.

    Attributes:
        rollout: what happened.
        advantage: (T, N) float32, normalised over the batch if the settings say so.
        returns: (T, N) float32.
    """

    rollout: Rollout
    advantage: jax.Array
    returns: jax.Array


def gather(
    config: TrainConfig,
    envs: Environments,
    state: TrainState,
    env_params: EnvParams,
    decide: Callable[..., Decision],
) -> tuple[TrainState, Experience, Metrics]:
    """Play a rollout.

    Args:
        config: settings.
        envs: the environments.
        state: where training stands.
        env_params: of the environments.
        decide: of ``ActorCritic.decide``.

    Returns:
        The state after it, one iteration further; the experience; and its metrics.
    """
    env_state, rollout = collect(
        envs,
        state.env_state,
        env_params,
        decide,
        action_key(state),
        config.num_steps,
        config.random_shift,
    )
    scaler, reward = state.scaler, rollout.reward
    if config.normalize_reward:
        scaler, reward = scaler(reward, rollout.done, rollout.valid, config.gamma)
    advantage, returns = gae(
        reward,
        rollout.value,
        rollout.last_value,
        rollout.terminated,
        rollout.truncated,
        config.gamma,
        config.gae_lambda,
    )
    weight = rollout.valid.astype(jnp.float32)
    metrics = _metrics(rollout, advantage, returns, weight)
    metrics["reward/scale"] = scaler.scale if config.normalize_reward else jnp.float32(1.0)
    if config.normalize_advantage == "batch":
        advantage = normalized(advantage, weight)
    state = state.replace(
        env_state=env_state,
        scaler=scaler,
        iteration=state.iteration + 1,
    )
    return state, Experience(rollout, advantage, returns), metrics


def _metrics(
    rollout: Rollout, advantage: jax.Array, returns: jax.Array, weight: jax.Array
) -> Metrics:
    done = rollout.done
    center = returns - mean(returns, weight)
    unexplained = returns - rollout.value
    unexplained -= mean(unexplained, weight)
    variance = mean(center**2, weight)
    saturated = jnp.mean(jnp.abs(rollout.unclipped_action) >= 1.0, -1)
    spread = advantage - mean(advantage, weight)
    return {
        # Sums, so that several iterations can be put together without loss.
        "episode/count": jnp.sum(done, dtype=jnp.int32),
        "episode/return_sum": jnp.sum(jnp.where(done, rollout.episode_return, 0.0)),
        "episode/length_sum": jnp.sum(jnp.where(done, rollout.episode_length, 0)),
        "advantage/mean": mean(advantage, weight),
        "advantage/std": jnp.sqrt(mean(spread**2, weight)),
        "return/mean": mean(returns, weight),
        "return/std": jnp.sqrt(variance),
        "value/explained_variance": 1.0 - mean(unexplained**2, weight) / (variance + 1e-8),
        "policy/saturation": mean(saturated, weight),
    }
