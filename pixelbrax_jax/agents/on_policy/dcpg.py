"""Delayed critic policy gradient (Moon, Lee and Song, arXiv 2210.09960), and two variants."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import linen as nn

from pixelbrax_jax.agents.config import Fraction, NotNegative, PositiveInt, TrainConfig
from pixelbrax_jax.agents.networks.actor_critic import ActorCritic
from pixelbrax_jax.agents.networks.encoders import dense
from pixelbrax_jax.agents.on_policy.algorithm import Experience, OnPolicyState
from pixelbrax_jax.agents.on_policy.losses import Batch, mean, policy_loss, value_loss
from pixelbrax_jax.agents.on_policy.phasic import Chunk, Phasic, PhasicConfig
from pixelbrax_jax.agents.rollout import split_obs
from pixelbrax_jax.agents.train_state import UPDATES, Metrics, Networks, stream_key
from pixelbrax_jax.validation import check_positive_int


@dataclass(frozen=True)
class DCPGConfig(PhasicConfig):
    """Settings of DCPG, or of DDCPG with ``dynamics_coef=1``."""

    update_epochs: PositiveInt = 1
    """Number of passes over a rollout in the policy phase."""
    value_distill_coef: NotNegative = 1.0
    """Weight lambda_V of the loss that keeps values constant in the policy phase."""
    dynamics_coef: NotNegative = 0.0
    """Weight c_f of DDCPG's dynamics loss in the delayed phase; 0 omits the dynamics head."""
    decoupled: bool = False
    """Computes advantages with a separate critic that learns in every policy phase."""
    vf_coef: NotNegative = 1.0
    """Weight of the separate critic's loss."""
    target_rate: Fraction = 0.05
    """Rate tau of the averaged actor that provides the old values in the decoupled variant."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # Values learn only in the delayed phase.
        check_positive_int("aux_epochs", self.aux_epochs)
        if self.state_critic and not self.decoupled:
            raise ValueError(
                "state_critic needs decoupled=True, got False: only the decoupled variant has a "
                "separate critic."
            )
        if self.dynamics_coef and self.num_steps * self.num_policy_phases == self.aux_minibatches:
            raise ValueError(
                f"dynamics_coef={self.dynamics_coef} needs at least 2 steps in a chunk, got 1: "
                f"aux_minibatches={self.aux_minibatches} must be less than num_steps * "
                f"num_policy_phases={self.num_steps * self.num_policy_phases}."
            )


class Dynamics(nn.Module):
    """Classifies whether an action leads from one observation's features to another's."""

    @nn.compact
    def __call__(self, features: jax.Array, action: jax.Array, following: jax.Array) -> jax.Array:
        """Map (B, F) features, (B, A) unclipped actions and (B, F) features to (B,) logits."""
        x = jnp.concatenate([features, action, following], axis=-1)
        for _ in range(2):
            x = nn.relu(dense(256)(x))
        return dense(1, 1.0)(x)[..., 0]


@dataclass(frozen=True)
class DCPG(Phasic):
    """DCPG: policy and value share an encoder, and values learn from old returns.

    DDCPG adds a dynamics head in the delayed phase. The decoupled variant has a separate critic.
    """

    config: DCPGConfig
    name: ClassVar[str] = "dcpg"
    config_class: ClassVar[type[TrainConfig]] = DCPGConfig

    @cached_property
    def agent(self) -> ActorCritic:
        """The networks without the dynamics head."""
        return self.make_agent(shared=not self.config.decoupled, has_value=True)

    def init_networks(self, key: jax.Array) -> Networks:
        """Sample initial parameters, also of the averaged actor and the dynamics head."""
        config, networks = self.config, super().init_networks(key)
        if config.decoupled:
            networks["target"] = networks["actor"]
        if config.dynamics_coef:
            spec, _ = split_obs(self.envs.env.obs_spec)
            pixels = jnp.zeros((1, *spec.shape), spec.dtype)
            features = self.agent.actor(networks["actor"], pixels).features
            action = jnp.zeros((1, self.envs.env.action_size))
            dynamics_key = jax.random.fold_in(key, 2)
            networks["dynamics"] = Dynamics().init(dynamics_key, features, action, features)
        return networks

    def learn(self, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
        """Run the policy phase: improve the policy and keep the values constant."""
        config, agent = self.config, self.agent
        target = state.networks.get("target")

        def loss(networks: Networks, batch: Batch, key: jax.Array) -> tuple[jax.Array, Metrics]:
            output = agent.actor(networks["actor"], batch.pixels)
            loss, metrics = policy_loss(output.policy, batch, config, key)
            # Without a separate critic, the batch contains the old values of the actor.
            kept = batch.value
            if config.decoupled:
                kept = agent.actor(target, batch.pixels).value
                value = agent.critic(networks["critic"], batch.pixels, batch.state)
                error = value_loss(value, batch.returns, batch.weight)
                metrics["loss/value"] = error
                loss += config.vf_coef * error
            distance = value_loss(output.value, kept, batch.weight)
            metrics["loss/value_distill"] = distance
            return loss + config.value_distill_coef * distance, metrics

        state, metrics = self.update(
            state, loss, experience, config.update_epochs, stream_key(state, UPDATES)
        )
        return self.remember(state, experience), metrics

    def auxiliary_loss(
        self, networks: Networks, chunk: Chunk, key: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of the delayed phase, which fits old returns and keeps the policy."""
        config = self.config
        output, loss, metrics = self.loss_with_kept_policy(networks, chunk, config.vf_coef)
        if config.dynamics_coef:
            wrong = dynamics_loss(networks["dynamics"], output.features, chunk, key)
            loss += config.dynamics_coef * wrong
            metrics["auxiliary/dynamics_loss"] = wrong
        return loss, metrics

    def after_auxiliary_step(self, networks: Networks) -> Networks:
        """Update the averaged actor."""
        if not self.config.decoupled:
            return networks
        rate = self.config.target_rate
        moved = jax.tree.map(
            lambda old, new: (1 - rate) * old + rate * new, networks["target"], networks["actor"]
        )
        return networks | {"target": moved}


def dynamics_loss(params: Networks, features: jax.Array, chunk: Chunk, key: jax.Array) -> jax.Array:
    """Return DDCPG's loss of a classifier of true and false transitions.

    ``l(f(z, a, z'), 1) + l(f(z, a~, z'), 0) / 2 + l(f(z, a, z~'), 0)`` with the logistic loss l,
    features z, action a, next features z', and a~ and z~' from other samples; the weights are those
    of the authors' code. Pairs across an episode's end have no weight. ``features`` are (N C, F).
    """

    def part(rows: jax.Array, steps: slice) -> jax.Array:
        rows = rows.reshape(-1, chunk.num_steps, *rows.shape[1:])[:, steps]
        return rows.reshape(-1, *rows.shape[2:])

    before, after = slice(None, -1), slice(1, None)
    now, following = part(features, before), part(features, after)
    action = part(chunk.unclipped_action, before)
    # A step that ends an episode returns its last observation; the next step resets the episode.
    weight = part(chunk.weight, before)
    action_key, following_key = jax.random.split(key)
    others = jax.random.permutation(action_key, len(action))
    strangers = jax.random.permutation(following_key, len(following))

    def logistic(action: jax.Array, following: jax.Array, sign: float) -> jax.Array:
        logit: jax.Array = Dynamics().apply(params, now, action, following)  # type: ignore[assignment]
        return mean(jax.nn.softplus(-sign * logit), weight)

    return (
        logistic(action, following, 1.0)
        + 0.5 * logistic(action[others], following, -1.0)
        + logistic(action, following[strangers], -1.0)
    )
