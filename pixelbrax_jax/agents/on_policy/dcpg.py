"""Delayed critic policy gradient (Moon, Lee and Song, arXiv 2210.09960), and two variants.

Policy and value share an encoder, and the value learns from returns only in the delayed phase,
long after they were collected: that keeps the encoder from memorising. DDCPG adds a dynamics
head to the delayed phase; the decoupled variant has a critic of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, check_positive
from pixelbrax_jax.agents.networks.actor import Dynamics
from pixelbrax_jax.agents.on_policy import phasic
from pixelbrax_jax.agents.on_policy.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.experience import gather
from pixelbrax_jax.agents.on_policy.losses import (
    Batch,
    Metrics,
    mean,
    policy_loss,
    policy_metrics,
    value_loss,
)
from pixelbrax_jax.agents.on_policy.update import update
from pixelbrax_jax.agents.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.train_state import TrainState, update_key
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_fraction, check_positive_int

_LEARNERS = ("actor", "critic")
"""Networks that learn in the policy phase."""


@dataclass(frozen=True)
class DCPGConfig(TrainConfig):
    """Settings of DCPG; of DDCPG with ``dynamics_coef`` = 1."""

    update_epochs: int = 1
    """Passes over a rollout in the policy phase."""
    value_distill_coef: float = 1.0
    """lambda_V, weight that keeps the value where it was while the policy learns."""
    num_policy_phases: int = 16
    """Rollouts between delayed phases, which learn from all of them."""
    aux_epochs: int = 4
    """E_aux, passes over the buffer."""
    aux_minibatches: int = 16
    """Minibatches of such a pass, a multiple of ``num_policy_phases``."""
    beta_clone: float = 1.0
    """lambda_pi, weight of KL(old policy || policy) in the delayed phase."""
    dynamics_coef: float = 0.0
    """c_f, weight of DDCPG's dynamics loss in the delayed phase; 0 has no dynamics head."""
    decoupled: bool = False
    """Whether advantages come from a critic of its own, which learns in every policy phase."""
    vf_coef: float = 1.0
    """Weight of that critic's loss."""
    target_rate: float = 0.05
    """tau of the averaged actor whose value is kept in the decoupled variant."""

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        super().__post_init__()
        check_positive_int("update_epochs", self.update_epochs)
        check_positive_int("aux_epochs", self.aux_epochs)
        for name in ("value_distill_coef", "beta_clone", "dynamics_coef", "vf_coef"):
            check_positive(name, getattr(self, name), or_zero=True)
        check_fraction("target_rate", self.target_rate)
        phasic.check_phases(self, self.num_policy_phases, self.aux_epochs, self.aux_minibatches)
        if self.state_critic and not self.decoupled:
            raise ValueError(
                "state_critic needs decoupled=True, got False: else there is no critic apart."
            )
        if self.dynamics_coef and self.num_steps * self.num_policy_phases == self.aux_minibatches:
            raise ValueError(
                f"dynamics_coef={self.dynamics_coef} needs at least 2 steps in a chunk, got 1: "
                f"aux_minibatches={self.aux_minibatches} must be less than num_steps * "
                f"num_policy_phases={self.num_steps * self.num_policy_phases}."
            )


@dataclass(frozen=True)
class DCPG(Algorithm):
    """DCPG with its settings, in the given environments."""

    config: DCPGConfig
    name: ClassVar[str] = "dcpg"
    config_class: ClassVar[type[TrainConfig]] = DCPGConfig

    @property
    def num_phases(self) -> int:
        """As ``Algorithm.num_phases``."""
        return self.config.num_policy_phases

    @cached_property
    def agent(self) -> ActorCritic:
        """Its networks, but for the dynamics head."""
        return ActorCritic(self.config, self.envs, shared=not self.config.decoupled, has_value=True)

    def init_networks(self, key: jax.Array) -> Networks:
        """As ``Algorithm.init_networks``."""
        config, networks = self.config, self.agent.init(key)
        if config.decoupled:
            networks["target"] = networks["actor"]
        if config.dynamics_coef:
            env = config.env
            pixels = jnp.zeros((1, env.height, env.width, 3 * env.frame_stack), jnp.uint8)
            features = self.agent.actor(networks["actor"], pixels).features
            action = jnp.zeros((1, self.envs.env.action_size))
            dynamics_key = jax.random.fold_in(key, 2)
            networks["dynamics"] = Dynamics().init(dynamics_key, features, action, features)
        return networks

    @under_default_flags
    def init(self, key: jax.Array, env_params: EnvParams) -> TrainState:
        """As ``Algorithm.init``, with an empty buffer."""
        state = super().init(key, env_params)
        decide = self.agent.decide(state.networks)
        state = phasic.with_buffer(
            self.config, self.envs, state, env_params, decide, self.config.num_policy_phases
        )
        # The averaged actor follows without a gradient; the dynamics head learns in one phase.
        optimizer, networks = Optimizer(self.config), state.networks
        return state.replace(
            opt_state=optimizer.init({n: p for n, p in networks.items() if n in _LEARNERS}),
            aux_opt_state=optimizer.init({n: p for n, p in networks.items() if n != "target"}),
        )

    @under_default_flags
    def iterate(self, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """Learn the policy, and keep the value where it was (the policy phase)."""
        config, agent = self.config, self.agent
        key, iteration = update_key(state), state.iteration
        state, experience, metrics = gather(
            config, self.envs, state, env_params, agent.decide(state.networks)
        )
        target = state.networks.get("target")

        def loss(networks: Networks, batch: Batch, key: jax.Array) -> tuple[jax.Array, Metrics]:
            output = agent.actor(networks["actor"], batch.pixels)
            loss, metrics = policy_loss(output.policy, batch, config, key)
            # Coupled, the actor's value is what played: its old values are in the batch.
            kept = batch.value
            if config.decoupled:
                kept = agent.actor(target, batch.pixels).value
                value = agent.critic(networks["critic"], batch.pixels, batch.state)
                error = value_loss(value, batch.returns, batch.weight)
                metrics["loss/value"] = error
                loss += config.vf_coef * error
            distance = value_loss(output.value, kept, batch.weight)
            metrics |= {"loss/value_distill": distance} | policy_metrics(output.policy.std)
            return loss + config.value_distill_coef * distance, metrics

        trained = {n: p for n, p in state.networks.items() if n in _LEARNERS}
        networks, opt_state, update_metrics = update(
            config,
            loss,
            trained,
            state.opt_state,
            experience,
            config.update_epochs,
            key,
            iteration,
        )
        slot = iteration % config.num_policy_phases
        state = state.replace(
            networks=state.networks | networks,
            opt_state=opt_state,
            buffer=phasic.remember(state.buffer, slot, experience),
        )
        rate = Optimizer(config).learning_rate(iteration)
        return state, metrics | update_metrics | {"learning_rate": rate}

    @under_default_flags
    def auxiliary(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """Learn the value from old returns, and keep the policy (the delayed phase)."""
        config, agent, dynamics = self.config, self.agent, Dynamics()

        def loss(
            networks: Networks, chunk: phasic.Chunk, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            critic_coef = config.vf_coef if config.decoupled else None
            output, loss, metrics = phasic.value_loss_with_kept_policy(
                agent, networks, chunk, config.beta_clone, critic_coef
            )
            if config.dynamics_coef:
                wrong = dynamics_loss(dynamics, networks["dynamics"], output.features, chunk, key)
                loss += config.dynamics_coef * wrong
                metrics["auxiliary/dynamics_loss"] = wrong
            return loss, metrics

        def after_step(networks: Networks) -> Networks:
            if not config.decoupled:
                return networks
            rate = config.target_rate
            moved = jax.tree.map(
                lambda old, new: (1 - rate) * old + rate * new,
                networks["target"],
                networks["actor"],
            )
            return networks | {"target": moved}

        return phasic.auxiliary_phase(
            config,
            state,
            lambda networks, pixels: agent.actor(networks["actor"], pixels).policy,
            loss,
            config.aux_epochs,
            config.aux_minibatches,
            after_step,
        )


def dynamics_loss(
    dynamics: Dynamics,
    params: Networks,
    features: jax.Array,
    chunk: phasic.Chunk,
    key: jax.Array,
) -> jax.Array:
    """Return DDCPG's loss: true transitions are told from wrong ones.

    With features z, action a and features z' one step later, and a logistic loss l:
    ``l(f(z, a, z'), 1) + l(f(z, a~, z'), 0) / 2 + l(f(z, a, z~'), 0)``, with the weights of the
    authors' code. Here a~ and z~' are those of another sample. Pairs that an episode's end parts
    are left out.

    Args:
        dynamics: the head.
        params: of the head.
        features: (N C, F) float32 of the chunk.
        chunk: C steps of N environments.
        key: for the exchange.

    Returns:
        () float32.
    """
    num_steps = chunk.num_steps

    def in_time(rows: jax.Array) -> jax.Array:
        return rows.reshape(-1, num_steps, *rows.shape[1:])

    def flat(rows: jax.Array) -> jax.Array:
        return rows.reshape(-1, *rows.shape[2:])

    now, following = flat(in_time(features)[:, :-1]), flat(in_time(features)[:, 1:])
    action = flat(in_time(chunk.unclipped_action)[:, :-1])
    # A step that ends an episode returns a true last observation; the one after it begins anew.
    weight = flat(in_time(chunk.weight)[:, :-1])
    action_key, following_key = jax.random.split(key)
    others = jax.random.permutation(action_key, len(action))
    strangers = jax.random.permutation(following_key, len(following))

    def logistic(action: jax.Array, following: jax.Array, sign: float) -> jax.Array:
        logit: jax.Array = dynamics.apply(params, now, action, following)  # type: ignore[assignment]
        return mean(jax.nn.softplus(-sign * logit), weight)

    return (
        logistic(action, following, 1.0)
        + 0.5 * logistic(action[others], following, -1.0)
        + logistic(action, following[strangers], -1.0)
    )
