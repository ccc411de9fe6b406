"""The base of PPG and DCPG: a buffer of rollouts and an auxiliary phase that learns from it."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.agents.config import Count, NotNegative, PositiveInt, check_divides
from pixelbrax_jax.agents.networks.actor_critic import ActorOutput
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.algorithm import (
    Experience,
    OnPolicy,
    OnPolicyState,
    passes,
)
from pixelbrax_jax.agents.on_policy.config import OnPolicyConfig
from pixelbrax_jax.agents.on_policy.losses import mean, value_loss
from pixelbrax_jax.agents.optimizer import Optimizer
from pixelbrax_jax.agents.rollout import Frames, at_times, observations
from pixelbrax_jax.agents.train_state import (
    AUXILIARY,
    Metrics,
    Networks,
    along_envs,
    as_declared,
    stream_key,
)
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams


@dataclass(frozen=True)
class PhasicConfig(OnPolicyConfig):
    """Settings of an auxiliary phase that learns from several rollouts."""

    memory_settings: ClassVar[tuple[str, ...]] = ("num_envs", "num_steps", "num_policy_phases")

    num_policy_phases: PositiveInt = 16
    """Number N_pi of rollouts between auxiliary phases (DCPG: delayed phases)."""
    aux_epochs: Count = 4
    """Number E_aux of passes over the buffer in an auxiliary phase."""
    aux_minibatches: PositiveInt = 16
    """Number of minibatches per pass, a multiple of ``num_policy_phases``."""
    beta_clone: NotNegative = 1.0
    """Weight of KL(old policy || policy) in the auxiliary phase."""

    def __post_init__(self) -> None:
        super().__post_init__()
        phases, minibatches = self.num_policy_phases, self.aux_minibatches
        if self.aux_epochs and self.num_iterations < phases:
            raise ValueError(
                f"the auxiliary phase would never run: it comes after every {phases} rollouts, and "
                f"total_steps={self.total_steps} are only {self.num_iterations}. Lower "
                "num_policy_phases or raise total_steps."
            )
        if minibatches % phases:
            raise ValueError(
                f"aux_minibatches={minibatches} must be a multiple of num_policy_phases={phases}: "
                "the steps of a minibatch come from one rollout."
            )
        of_rollout = "aux_minibatches / num_policy_phases"
        check_divides("num_steps", self.num_steps, of_rollout, minibatches // phases)


class Buffer(struct.PyTreeNode):
    """P rollouts: (P, T, N, ...) arrays with the meaning of ``Rollout``, and ``Frames`` with P."""

    frames: Frames = as_declared(leading_axes=1)
    unclipped_action: jax.Array = along_envs(2)
    returns: jax.Array = along_envs(2)
    done: jax.Array = along_envs(2)
    valid: jax.Array = along_envs(2)


class Chunk(NamedTuple):
    """B = N C samples: C consecutive steps of each of N environments, ordered by environment.

    Shapes are those of ``Batch``; ``policy`` is that before the phase, and ``num_steps`` is C.
    """

    pixels: jax.Array
    state: jax.Array | None
    unclipped_action: jax.Array
    returns: jax.Array
    weight: jax.Array
    policy: Normal
    num_steps: int


@dataclass(frozen=True)
class Phasic(OnPolicy):
    """An on-policy algorithm with an auxiliary phase; ``learn`` must call ``remember``."""

    config: PhasicConfig

    @abstractmethod
    def auxiliary_loss(
        self, networks: Networks, chunk: Chunk, key: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of a chunk in the auxiliary phase and scalars to log."""

    def after_auxiliary_step(self, networks: Networks) -> Networks:
        """Change the networks after an optimiser step of the auxiliary phase."""
        return networks

    @property
    def auxiliary_every(self) -> int:
        """See ``Algorithm.auxiliary_every``."""
        return self.config.num_policy_phases if self.config.aux_epochs else 0

    @under_default_flags
    def init(self, key: jax.Array, env_params: EnvParams) -> OnPolicyState:
        """See ``Algorithm.init``; the buffer is zero."""
        state = super().init(key, env_params)
        rollout = jax.eval_shape(lambda: _entry(self.gather(state, env_params)[1]))
        phases = self.config.num_policy_phases
        buffer = jax.tree.map(lambda x: jnp.zeros((phases, *x.shape), x.dtype), rollout)
        # The averaged actor "target" has no gradient; "dynamics" learns only in auxiliary phases.
        optimizer, networks = Optimizer(self.config), state.networks
        learners = {n: p for n, p in networks.items() if n in ("actor", "critic")}
        aux_learners = {n: p for n, p in networks.items() if n != "target"}
        return state.replace(
            opt_state=optimizer.init(learners),
            aux_opt_state=optimizer.init(aux_learners),
            buffer=buffer,
        )

    def remember(self, state: OnPolicyState, experience: Experience) -> OnPolicyState:
        """Replace the oldest rollout in the buffer."""
        slot = state.iteration % self.config.num_policy_phases
        buffer = jax.tree.map(
            lambda whole, one: jax.lax.dynamic_update_index_in_dim(whole, one, slot, 0),
            state.buffer,
            _entry(experience),
        )
        return state.replace(buffer=buffer)

    @under_default_flags
    def auxiliary(self, state: OnPolicyState) -> tuple[OnPolicyState, Metrics]:
        """Learn from the full buffer with a separate optimiser state; average the metrics."""
        config, optimizer = self.config, Optimizer(self.config)
        key = stream_key(state, AUXILIARY)
        num_chunks = config.aux_minibatches
        # Uses the step size of the previous iteration, because an annealed one ends at 0.
        iteration = state.iteration - 1

        def old_policy(_: None, number: jax.Array) -> tuple[None, tuple[jax.Array, jax.Array]]:
            chunk = self._chunk(state.buffer, jnp.full(config.num_envs, number), None)
            policy = self.agent.actor(state.networks["actor"], chunk.pixels).policy
            shape = (config.num_envs, chunk.num_steps, -1)
            return None, (policy.mean.reshape(shape), policy.std.reshape(shape))

        _, old = jax.lax.scan(old_policy, None, jnp.arange(num_chunks))
        squash = config.policy == "tanh_gaussian"

        def step(carry: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Metrics]:
            networks, opt_state = carry
            which, key = inputs
            mean, std = (at_times(x, which).reshape(-1, x.shape[-1]) for x in old)
            chunk = self._chunk(state.buffer, which[0], Normal(mean, std, squash))
            gradients, metrics = jax.grad(self.auxiliary_loss, has_aux=True)(networks, chunk, key)
            gradients = {name: gradients[name] for name in opt_state}
            networks, opt_state, norms = optimizer.step(networks, opt_state, gradients, iteration)
            metrics |= {f"auxiliary/grad_norm/{name}": norm for name, norm in norms.items()}
            return (self.after_auxiliary_step(networks), opt_state), metrics

        carry = (state.networks, state.aux_opt_state)
        # A minibatch has one chunk of each environment.
        (networks, opt_state), metrics = passes(
            step, carry, key, config.aux_epochs, num_chunks, config.num_envs, num_chunks
        )
        state = state.replace(networks=networks, aux_opt_state=opt_state)
        return state, jax.tree.map(jnp.mean, metrics)

    def loss_with_kept_policy(
        self, networks: Networks, chunk: Chunk, critic_coef: float
    ) -> tuple[ActorOutput, jax.Array, Metrics]:
        """Return the actor's output, a loss that fits values and keeps the policy, and metrics."""
        output = self.agent.actor(networks["actor"], chunk.pixels)
        error = value_loss(output.value, chunk.returns, chunk.weight)
        kl = mean(chunk.policy.kl_to(output.policy), chunk.weight)
        loss = error + self.config.beta_clone * kl
        metrics = {"auxiliary/value_loss": error, "auxiliary/kl": kl}
        if self.agent.critic_module is not None:
            value = self.agent.critic(networks["critic"], chunk.pixels, chunk.state)
            critic_error = value_loss(value, chunk.returns, chunk.weight)
            loss += critic_coef * critic_error
            metrics["auxiliary/critic_loss"] = critic_error
        return output, loss, metrics

    def _chunk(self, buffer: Buffer, which: jax.Array, policy: Any) -> Chunk:
        """Return chunk ``which``, (N,) int32 below ``aux_minibatches``, of each environment."""
        config = self.config
        parts = config.aux_minibatches // config.num_policy_phases
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
        rows = (frames.state, buffer.unclipped_action, buffer.returns, buffer.valid)
        state, action, returns, valid = jax.tree.map(flat, rows)
        pixels = observations(seen, times, config.random_shift)
        return Chunk(pixels, state, action, returns, valid.astype(jnp.float32), policy, num_steps)


def _entry(experience: Experience) -> Buffer:
    rollout = experience.rollout
    action = rollout.choice.unclipped_action
    return Buffer(rollout.frames, action, experience.returns, rollout.done, rollout.valid)
