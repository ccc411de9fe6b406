"""Proximal policy optimisation (Schulman et al., arXiv 1707.06347)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

import jax

from pixelbrax_jax.agents.config import NotNegative, PositiveInt, TrainConfig
from pixelbrax_jax.agents.networks.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.algorithm import Experience, OnPolicy, OnPolicyState
from pixelbrax_jax.agents.on_policy.config import OnPolicyConfig
from pixelbrax_jax.agents.on_policy.losses import (
    Batch,
    clipped_value_loss,
    policy_loss,
    value_loss,
)
from pixelbrax_jax.agents.train_state import UPDATES, Metrics, Networks, stream_key
from pixelbrax_jax.validation import check_choice, check_positive


@dataclass(frozen=True)
class PPOConfig(OnPolicyConfig):
    """Settings of PPO."""

    layout: str = "separate"
    """Encoders of policy and value: ``separate`` or ``shared``."""
    update_epochs: PositiveInt = 3
    """Number of passes over a rollout."""
    vf_coef: NotNegative = 0.5
    """Weight of the value loss, which is half the mean squared error."""
    clip_value: bool = False
    """Limits the change of the value with ``clip_coef``, like that of the policy."""
    target_kl: Annotated[float | None, check_positive] = None
    """Stops an update early above this approximate KL divergence."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("layout", self.layout, ("separate", "shared"))
        if self.state_critic and self.layout == "shared":
            raise ValueError(
                "state_critic needs layout='separate', got 'shared': a critic of the simulator's "
                "state has no encoder to share."
            )


@dataclass(frozen=True)
class PPO(OnPolicy):
    """PPO: several epochs of a clipped objective after each rollout."""

    config: PPOConfig
    name: ClassVar[str] = "ppo"
    config_class: ClassVar[type[TrainConfig]] = PPOConfig

    @cached_property
    def agent(self) -> ActorCritic:
        """The networks."""
        shared = self.config.layout == "shared"
        return self.make_agent(shared=shared, has_value=shared)

    def learn(self, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
        """See ``OnPolicy.learn``."""
        config = self.config
        return self.update(
            state,
            self.loss,
            experience,
            config.update_epochs,
            stream_key(state, UPDATES),
            target_kl=config.target_kl,
        )

    def loss(self, networks: Networks, batch: Batch, key: jax.Array) -> tuple[jax.Array, Metrics]:
        """Return the loss of a batch and scalars to log."""
        config = self.config
        policy, value = self.agent(networks, batch.pixels, batch.state)
        loss, metrics = policy_loss(policy, batch, config, key)
        if config.clip_value:
            error = clipped_value_loss(value, batch, config.clip_coef)
        else:
            error = value_loss(value, batch.returns, batch.weight)
        return loss + config.vf_coef * error, metrics | {"loss/value": error}
