"""Phasic policy gradient (Cobbe et al., arXiv 2009.04416)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import NotNegative, PositiveInt, TrainConfig
from pixelbrax_jax.agents.networks.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.algorithm import Experience, OnPolicyState
from pixelbrax_jax.agents.on_policy.losses import Batch, policy_loss, value_loss
from pixelbrax_jax.agents.on_policy.phasic import Chunk, Phasic, PhasicConfig
from pixelbrax_jax.agents.train_state import UPDATES, Metrics, Networks, stream_key
from pixelbrax_jax.validation import check_choice


@dataclass(frozen=True)
class PPGConfig(PhasicConfig):
    """Settings of PPG."""

    layout: str = "dual"
    """Encoders of policy and value: ``dual`` (separate), ``shared``, or ``detach`` (shared, without
    gradients of the value in policy phases)."""
    policy_epochs: PositiveInt = 1
    """Number E_pi of passes over a rollout for the policy."""
    value_epochs: PositiveInt = 1
    """Number E_V of passes over a rollout for the value."""
    vf_coef: NotNegative = 1.0
    """Weight of the value loss, which is half the mean squared error."""
    aux_value_coef: NotNegative = 1.0
    """Weight of the separate critic's loss in the auxiliary phase."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("layout", self.layout, ("dual", "detach", "shared"))
        if self.layout != "dual" and self.policy_epochs != self.value_epochs:
            raise ValueError(
                f"policy_epochs={self.policy_epochs} and value_epochs={self.value_epochs} may "
                f"differ only with layout='dual', got {self.layout!r}: the passes of one would "
                "change the other, because they share a network."
            )
        if self.state_critic and self.layout != "dual":
            raise ValueError(
                f"state_critic needs layout='dual', got {self.layout!r}: a critic of the "
                "simulator's state has no encoder to share."
            )


@dataclass(frozen=True)
class PPG(Phasic):
    """PPG: policy phases, and auxiliary phases that distil values into the actor's encoder."""

    config: PPGConfig
    name: ClassVar[str] = "ppg"
    config_class: ClassVar[type[TrainConfig]] = PPGConfig

    @cached_property
    def agent(self) -> ActorCritic:
        """The networks."""
        layout = self.config.layout
        return self.make_agent(shared=layout != "dual", has_value=True, detach=layout == "detach")

    def learn(self, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
        """Run the policy phase: learn like PPO and store the rollout."""
        config, agent, key = self.config, self.agent, stream_key(state, UPDATES)

        def loss(
            of_policy: bool, of_value: bool, networks: Networks, batch: Batch, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            policy, value = agent(networks, batch.pixels, batch.state)
            total, metrics = jnp.float32(0.0), dict[str, jax.Array]()
            if of_policy:
                total, metrics = policy_loss(policy, batch, config, key)
            if of_value:
                error = value_loss(value, batch.returns, batch.weight)
                total += config.vf_coef * error
                metrics["loss/value"] = error
            return total, metrics

        # Policy and value share the first passes; further passes follow for one of them.
        shared_epochs = min(config.policy_epochs, config.value_epochs)
        value_network = "critic" if config.layout == "dual" else "actor"
        plan = (
            (partial(loss, True, True), shared_epochs, tuple(state.networks)),
            (partial(loss, True, False), config.policy_epochs - shared_epochs, ("actor",)),
            (partial(loss, False, True), config.value_epochs - shared_epochs, (value_network,)),
        )
        metrics: Metrics = {}
        for part, (part_loss, num_epochs, learners) in enumerate(plan):
            if num_epochs:
                # Does not collide with the keys of the passes, which have small numbers.
                part_key = key if part == 0 else jax.random.fold_in(key, 2**31 + part)
                state, part_metrics = self.update(
                    state, part_loss, experience, num_epochs, part_key, learners=learners
                )
                metrics |= part_metrics
        return self.remember(state, experience), metrics

    def auxiliary_loss(
        self, networks: Networks, chunk: Chunk, key: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss that distils values into the actor's encoder and keeps the policy."""
        del key
        _, loss, metrics = self.loss_with_kept_policy(networks, chunk, self.config.aux_value_coef)
        return loss, metrics
