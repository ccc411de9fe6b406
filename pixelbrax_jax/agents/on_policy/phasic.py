"""What PPG and DCPG share: a buffer of rollouts, and a phase that learns from all of them.

A buffer holds P rollouts of N environments. The phase cuts each rollout into equal chunks of
consecutive steps, and each of its minibatches has one chunk of every environment.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.config import TrainConfig, check_divides
from pixelbrax_jax.agents.env_axis import along_envs, as_declared
from pixelbrax_jax.agents.networks.actor import ActorOutput
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.experience import Experience, gather
from pixelbrax_jax.agents.on_policy.losses import Metrics, mean, value_loss
from pixelbrax_jax.agents.on_policy.rollout import (
    Decision,
    Environments,
    Frames,
    minibatch_times,
    observations,
)
from pixelbrax_jax.agents.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.train_state import TrainState, auxiliary_key
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_positive_int


class Buffer(struct.PyTreeNode):
    """P rollouts; every array has a leading axis P.

    Attributes:
        frames: what was seen.
        unclipped_action: (P, T, N, A) float32.
        returns: (P, T, N) float32.
        done: (P, T, N) bool, an episode ended.
        valid: (P, T, N) bool, the step did not merely begin an episode.
    """

    frames: Frames = as_declared(leading_axes=1)
    unclipped_action: jax.Array = along_envs(2)
    returns: jax.Array = along_envs(2)
    done: jax.Array = along_envs(2)
    valid: jax.Array = along_envs(2)


class Chunk(NamedTuple):
    """B = N C samples, C consecutive steps of each of N environments, one after the other.

    Attributes:
        pixels: (B, H, W, 3 K) uint8.
        state: (B, S) float32, or None.
        unclipped_action: (B, A) float32.
        returns: (B,) float32.
        weight: (B,) float32, 0 for steps that teach nothing.
        done: (B,) bool.
        policy: the distribution of actions before the phase.
        num_steps: C.
    """

    pixels: jax.Array
    state: jax.Array | None
    unclipped_action: jax.Array
    returns: jax.Array
    weight: jax.Array
    done: jax.Array
    policy: Normal
    num_steps: int


Loss = Callable[[Networks, Chunk, jax.Array], tuple[jax.Array, Metrics]]


def check_phases(
    config: TrainConfig, num_policy_phases: int, aux_epochs: int, aux_minibatches: int
) -> None:
    """Reject settings with which the auxiliary phase cannot be.

    Raises:
        ValueError: the message says what is allowed.
    """
    check_positive_int("num_policy_phases", num_policy_phases)
    check_positive_int("aux_minibatches", aux_minibatches)
    if aux_epochs and config.num_iterations < num_policy_phases:
        raise ValueError(
            f"the auxiliary phase would never run: it comes after every {num_policy_phases} "
            f"rollouts, and total_steps={config.total_steps} are only {config.num_iterations}. "
            "Lower num_policy_phases or raise total_steps."
        )
    if aux_minibatches % num_policy_phases:
        raise ValueError(
            f"aux_minibatches={aux_minibatches} must be a multiple of "
            f"num_policy_phases={num_policy_phases}: a minibatch has steps of one rollout."
        )
    check_divides(
        "num_steps",
        config.num_steps,
        "aux_minibatches / num_policy_phases",
        aux_minibatches // num_policy_phases,
    )


def with_buffer(
    config: TrainConfig,
    envs: Environments,
    state: TrainState,
    env_params: EnvParams,
    decide: Callable[..., Decision],
    num_policy_phases: int,
) -> TrainState:
    """Return ``state`` with an empty buffer."""

    def one() -> Buffer:
        return _entry(gather(config, envs, state, env_params, decide)[1])

    buffer = jax.tree.map(
        lambda x: jnp.zeros((num_policy_phases, *x.shape), x.dtype), jax.eval_shape(one)
    )
    return state.replace(buffer=buffer)


def remember(buffer: Buffer, slot: jax.Array, experience: Experience) -> Buffer:
    """Return the buffer with one rollout more.

    Args:
        buffer: with P rollouts.
        slot: () where to put it, in [0, P).
        experience: the rollout.
    """
    return jax.tree.map(
        lambda whole, one: jax.lax.dynamic_update_index_in_dim(whole, one, slot, 0),
        buffer,
        _entry(experience),
    )


def auxiliary_phase(
    config: TrainConfig,
    state: TrainState,
    policy_of: Callable[[Networks, jax.Array], Normal],
    loss: Loss,
    number: int,
    num_minibatches: int,
    after_step: Callable[[Networks], Networks] = lambda networks: networks,
) -> tuple[TrainState, Metrics]:
    """Pass over the buffer with an optimiser of its own.

    Args:
        config: settings.
        state: with a full buffer.
        policy_of: distribution of actions of (B, H, W, 3 K) pixels.
        loss: of networks, a chunk and a key.
        number: of passes.
        num_minibatches: of a pass, P times the chunks of a rollout.
        after_step: what is done to the networks after each step of the optimiser.

    Returns:
        The state, and the mean of each metric over all minibatches.
    """
    buffer, key = state.buffer, auxiliary_key(state)
    num_rollouts = buffer.returns.shape[0]
    parts = num_minibatches // num_rollouts
    optimizer = Optimizer(config)
    # The step size of the rollout before: after the last one, that of the next would be 0.
    iteration = state.iteration - 1

    def old_policy(_: None, number: jax.Array) -> tuple[None, tuple[jax.Array, jax.Array]]:
        chunk = _chunk(config, buffer, jnp.full(config.num_envs, number), parts, None)
        policy = policy_of(state.networks, chunk.pixels)
        shape = (config.num_envs, chunk.num_steps, -1)
        return None, (policy.mean.reshape(shape), policy.std.reshape(shape))

    _, old = jax.lax.scan(old_policy, None, jnp.arange(num_minibatches))
    squash = config.policy == "tanh_gaussian"

    def step(carry: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Metrics]:
        networks, opt_state = carry
        which, key = inputs
        mean, std = (_of_each(x, which) for x in old)
        chunk = _chunk(config, buffer, which, parts, Normal(mean, std, squash))
        gradients, metrics = jax.grad(loss, has_aux=True)(networks, chunk, key)
        gradients = {name: gradients[name] for name in opt_state}
        networks, opt_state, norms = optimizer.step(networks, opt_state, gradients, iteration)
        metrics |= {f"auxiliary/grad_norm/{name}": norm for name, norm in norms.items()}
        return (after_step(networks), opt_state), metrics

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, Metrics]:
        order = minibatch_times(
            jax.random.fold_in(key, 0), num_minibatches, config.num_envs, num_minibatches
        )
        keys = jax.random.split(jax.random.fold_in(key, 1), num_minibatches)
        return jax.lax.scan(step, carry, (order[:, 0], keys))

    carry = (state.networks, state.aux_opt_state)
    (networks, opt_state), metrics = jax.lax.scan(epoch, carry, jax.random.split(key, number))
    state = state.replace(networks=networks, aux_opt_state=opt_state)
    return state, jax.tree.map(jnp.mean, metrics)


def value_loss_with_kept_policy(
    agent: ActorCritic,
    networks: Networks,
    chunk: Chunk,
    beta_clone: float,
    critic_coef: float | None,
) -> tuple[ActorOutput, jax.Array, Metrics]:
    """Return the loss by which values learn from the buffer while the policy stays.

    Args:
        agent: an actor with a value head.
        networks: parameters.
        chunk: samples of the buffer.
        beta_clone: weight of KL(old policy || policy).
        critic_coef: weight of the separate critic's loss; None where there is no such critic.

    Returns:
        The actor's output, () float32, and metrics.
    """
    output = agent.actor(networks["actor"], chunk.pixels)
    error = value_loss(output.value, chunk.returns, chunk.weight)
    kl = mean(chunk.policy.kl_to(output.policy), chunk.weight)
    loss = error + beta_clone * kl
    metrics = {"auxiliary/value_loss": error, "auxiliary/kl": kl}
    if critic_coef is not None:
        value = agent.critic(networks["critic"], chunk.pixels, chunk.state)
        critic_error = value_loss(value, chunk.returns, chunk.weight)
        loss += critic_coef * critic_error
        metrics["auxiliary/critic_loss"] = critic_error
    return output, loss, metrics


def _entry(experience: Experience) -> Buffer:
    rollout = experience.rollout
    return Buffer(
        rollout.frames, rollout.unclipped_action, experience.returns, rollout.done, rollout.valid
    )


def _of_each(chunks: jax.Array, which: jax.Array) -> jax.Array:
    """Map (Q, N, C, ...) and (N,) to (N C, ...), of each environment another chunk."""
    picked = jax.vmap(lambda x, i: x[i], in_axes=(1, 0))(chunks, which)
    return picked.reshape(-1, *picked.shape[2:])


def _chunk(
    config: TrainConfig, buffer: Buffer, which: jax.Array, parts: int, policy: Normal | None
) -> Chunk:
    """Return chunk ``which``, (N,) int32 in [0, P parts), of each environment."""
    num_steps = config.num_steps // parts
    rollout, first = which // parts, which % parts * num_steps

    def cut(rows: jax.Array, more: int = 0) -> jax.Array:
        """Map (P, T, N, ...) to (C + more, N, ...)."""

        def of_env(rows: jax.Array, rollout: jax.Array, first: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice_in_dim(rows[rollout], first, num_steps + more)

        return jax.vmap(of_env, in_axes=(2, 0, 0), out_axes=1)(rows, rollout, first)

    def flat(rows: jax.Array) -> jax.Array:
        rows = jnp.moveaxis(cut(rows), 1, 0)
        return rows.reshape(-1, *rows.shape[2:])

    frames = buffer.frames
    seen = Frames(
        pixels=cut(frames.pixels, config.env.frame_stack - 1),
        age=cut(frames.age),
        shift=frames.shift[rollout, jnp.arange(config.num_envs)],
        state=None,
    )
    times = jnp.broadcast_to(jnp.arange(num_steps)[:, None], (num_steps, config.num_envs))
    return Chunk(
        pixels=observations(seen, times, config.random_shift),
        state=None if frames.state is None else flat(frames.state),
        unclipped_action=flat(buffer.unclipped_action),
        returns=flat(buffer.returns),
        weight=flat(buffer.valid).astype(jnp.float32),
        done=flat(buffer.done),
        policy=policy,  # type: ignore[arg-type]
        num_steps=num_steps,
    )
