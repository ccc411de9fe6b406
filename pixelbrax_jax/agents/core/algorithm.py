"""What an algorithm is: where training stands, and the steps that carry it on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.core.config import TrainConfig, make_env
from pixelbrax_jax.agents.core.counter import StepCounter
from pixelbrax_jax.agents.core.losses import Metrics, mean, normalized
from pixelbrax_jax.agents.core.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.core.returns import RewardScaler, gae
from pixelbrax_jax.agents.core.rollout import Decision, Environments, Rollout, collect
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.types import EnvParams, EnvState

_ENVS, _NETWORKS, _ACTIONS, _UPDATES, _AUXILIARY = range(5)
"""Names of random streams, folded into the key of a run."""


class TrainState(struct.PyTreeNode):
    """Where training stands; all of it, so that a run goes on from it as if never stopped.

    Attributes:
        networks: parameters by name of the network.
        moments: of the optimiser, by name of the network.
        aux_moments: of the optimiser of the auxiliary phase; None where there is none.
        env_state: where the environments are.
        scaler: statistics of rewards.
        buffer: what the auxiliary phase will learn from; None where there is none.
        key: typed PRNG key of the run; never changes.
        iteration: () uint32, rollouts so far.
        steps: control steps so far, over all environments.
    """

    networks: Networks
    moments: Networks
    aux_moments: Networks | None
    env_state: EnvState
    scaler: RewardScaler
    buffer: Any
    key: jax.Array
    iteration: jax.Array
    steps: StepCounter


@dataclass(frozen=True)
class Algorithm:
    """An algorithm with its settings, as pure functions.

    Attributes:
        name: what it is called.
        config: its settings.
        envs: the environments it plays in.
        init: ``init(key, env_params) -> TrainState``.
        iterate: ``iterate(state, env_params) -> (state, metrics)``, a rollout and an update.
        act: ``act(networks, pixels, key) -> action``, (N, H, W, 3 K) uint8 to (N, A) float32;
            without a key the mean action.
        auxiliary: ``auxiliary(state) -> (state, metrics)``; None where there is none.
        num_phases: after how many iterations the auxiliary phase comes; 0 means never.
    """

    name: str
    config: TrainConfig
    envs: Environments
    init: Callable[[jax.Array, EnvParams], TrainState]
    iterate: Callable[[TrainState, EnvParams], tuple[TrainState, Metrics]]
    act: Callable[..., jax.Array]
    auxiliary: Callable[[TrainState], tuple[TrainState, Metrics]] | None = None
    num_phases: int = 0


def environments(
    config: TrainConfig, envs: Environments | None, env_params: EnvParams | None
) -> tuple[Environments, EnvParams]:
    """The given environments and their parameters, or those that ``config`` names.

    Raises:
        ValueError: one of the two is given without the other.
    """
    if envs is not None and env_params is not None:
        return envs, env_params
    if envs is not None or env_params is not None:
        missing = "envs" if envs is None else "env_params"
        raise ValueError(f"envs and env_params belong together, got no {missing}.")
    env, env_params = make_env(config)
    return VectorPixelEnv(env, config.num_envs), env_params


def check_environments(config: TrainConfig, envs: Environments) -> None:
    """Rejects environments that are not what the settings say.

    Raises:
        ValueError: naming the setting and both values.
    """
    if envs.autoreset_mode != "next_step":
        raise ValueError(
            f"autoreset_mode of the environments must be 'next_step', got {envs.autoreset_mode!r}."
        )
    specs = envs.env.obs_spec
    specs = specs if isinstance(specs, dict) else {"pixels": specs}
    spec = specs.get("pixels")
    if spec is None or len(spec.shape) != 3 or (config.state_critic and "state" not in specs):
        wanted = "both" if config.state_critic else "pixels"
        raise ValueError(
            f"obs_mode of the environments must be {wanted!r} with "
            f"state_critic={config.state_critic}; they show {', '.join(specs)}."
        )
    found = {
        "num_envs": (config.num_envs, envs.num_envs),
        "action_repeat": (config.action_repeat, envs.env.action_repeat),
        "frame_stack": (config.frame_stack, spec.shape[-1] // 3),
        "height": (config.height, spec.shape[0]),
        "width": (config.width, spec.shape[1]),
    }
    for name, (told, given) in found.items():
        if told != given:
            raise ValueError(f"{name} is {told} in the settings, but {given} in the environments.")


def begin(
    config: TrainConfig,
    envs: Environments,
    init_networks: Callable[[jax.Array], Networks],
    key: jax.Array,
    env_params: EnvParams,
) -> TrainState:
    """The state before the first iteration, without an auxiliary phase."""
    networks = init_networks(jax.random.fold_in(key, _NETWORKS))
    env_state, _ = envs.reset(jax.random.fold_in(key, _ENVS), env_params)
    return TrainState(
        networks=networks,
        moments=Optimizer(config).init(networks),
        aux_moments=None,
        env_state=env_state,
        scaler=RewardScaler.start(config.num_envs),
        buffer=None,
        key=key,
        iteration=jnp.uint32(0),
        steps=StepCounter.of(0),
    )


def update_key(state: TrainState) -> jax.Array:
    """Key of this iteration's update."""
    return jax.random.fold_in(jax.random.fold_in(state.key, _UPDATES), state.iteration)


def auxiliary_key(state: TrainState) -> jax.Array:
    """Key of the auxiliary phase that follows this iteration."""
    return jax.random.fold_in(jax.random.fold_in(state.key, _AUXILIARY), state.iteration)


def play(
    config: TrainConfig,
    envs: Environments,
    state: TrainState,
    env_params: EnvParams,
    decide: Callable[..., Decision],
) -> tuple[TrainState, Rollout, jax.Array, jax.Array, Metrics]:
    """A rollout with its advantages and returns.

    Returns:
        The state after it, with counters moved on; the rollout; advantages, normalised over the
        batch if the settings say so; returns; and what happened, as metrics.
    """
    key = jax.random.fold_in(jax.random.fold_in(state.key, _ACTIONS), state.iteration)
    env_state, rollout = collect(
        envs, state.env_state, env_params, decide, key, config.num_steps, config.random_shift
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
    metrics = _rollout_metrics(rollout, advantage, returns, weight)
    metrics["reward/scale"] = scaler.scale if config.normalize_reward else jnp.float32(1.0)
    if config.normalize_advantage == "batch":
        advantage = normalized(advantage, weight)
    state = state.replace(
        env_state=env_state,
        scaler=scaler,
        iteration=state.iteration + 1,
        steps=state.steps + config.steps_per_iteration,
    )
    return state, rollout, advantage, returns, metrics


def _rollout_metrics(
    rollout: Rollout, advantage: jax.Array, returns: jax.Array, weight: jax.Array
) -> Metrics:
    done = rollout.done
    center = returns - mean(returns, weight)
    unexplained = returns - rollout.value
    unexplained -= mean(unexplained, weight)
    variance = mean(center**2, weight)
    saturated = jnp.mean(jnp.abs(rollout.raw) >= 1.0, -1)
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


def policy_metrics(std: jax.Array) -> Metrics:
    """What is told of a policy's standard deviations, (..., A)."""
    return {"policy/std_min": std.min(), "policy/std_mean": std.mean(), "policy/std_max": std.max()}


def train_function(
    algorithm: Algorithm, env_params: EnvParams
) -> Callable[[jax.Array], tuple[TrainState, Metrics]]:
    """A whole run as a pure function of a key.

    The function may be jitted, and mapped over keys by ``jax.vmap``.

    Args:
        algorithm: with its settings.
        env_params: of the environments.

    Returns:
        ``train(key) -> (state, metrics)``; metrics have a leading axis of iterations, those of the
        auxiliary phase one of phases.
    """
    iterations, phases = algorithm.config.num_iterations, algorithm.num_phases

    def several(state: TrainState, number: int) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda state, _: algorithm.iterate(state, env_params), state, length=number
        )

    def phase(state: TrainState, _: None) -> tuple[TrainState, tuple[Metrics, Metrics]]:
        assert algorithm.auxiliary is not None
        state, metrics = several(state, phases)
        state, aux_metrics = algorithm.auxiliary(state)
        return state, (metrics, aux_metrics)

    def train(key: jax.Array) -> tuple[TrainState, Metrics]:
        state = algorithm.init(key, env_params)
        if not phases:
            return several(state, iterations)
        state, (metrics, aux_metrics) = jax.lax.scan(phase, state, length=iterations // phases)
        metrics = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), metrics)
        if iterations % phases:
            state, rest = several(state, iterations % phases)
            metrics = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), metrics, rest)
        return state, metrics | aux_metrics

    return train
