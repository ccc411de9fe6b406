"""Proximal policy optimisation (Schulman et al., arXiv 1707.06347)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import jax

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, check_positive
from pixelbrax_jax.agents.on_policy.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.experience import gather
from pixelbrax_jax.agents.on_policy.losses import (
    Batch,
    Metrics,
    clipped_value_loss,
    policy_loss,
    policy_metrics,
    value_loss,
)
from pixelbrax_jax.agents.on_policy.update import update
from pixelbrax_jax.agents.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.train_state import TrainState, update_key
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_choice, check_positive_int

LAYOUTS = ("separate", "shared")


@dataclass(frozen=True)
class PPOConfig(TrainConfig):
    """Settings of PPO."""

    layout: str = "separate"
    """``separate`` encoders for policy and value, or one that is ``shared``."""
    update_epochs: int = 3
    """Passes over a rollout."""
    vf_coef: float = 0.5
    """Weight of the value loss, half the mean squared error."""
    clip_value: bool = False
    """Whether the value is kept near what it was, as the policy is."""
    target_kl: float | None = None
    """Approximate KL divergence beyond which an update stops early."""

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        super().__post_init__()
        check_choice("layout", self.layout, LAYOUTS)
        check_positive_int("update_epochs", self.update_epochs)
        check_positive("vf_coef", self.vf_coef, or_zero=True)
        if self.target_kl is not None:
            check_positive("target_kl", self.target_kl)
        if self.state_critic and self.layout == "shared":
            raise ValueError(
                "state_critic needs layout='separate', got 'shared': it has no encoder to share."
            )


@dataclass(frozen=True)
class PPO(Algorithm):
    """PPO with its settings, in the given environments."""

    config: PPOConfig
    name: ClassVar[str] = "ppo"
    config_class: ClassVar[type[TrainConfig]] = PPOConfig

    @cached_property
    def agent(self) -> ActorCritic:
        """Its networks."""
        return ActorCritic(self.config, self.envs, shared=self.config.layout == "shared")

    @under_default_flags
    def iterate(self, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """As ``Algorithm.iterate``."""
        config, agent = self.config, self.agent
        key, iteration = update_key(state), state.iteration
        state, experience, metrics = gather(
            config, self.envs, state, env_params, agent.decide(state.networks)
        )

        def loss(networks: Networks, batch: Batch, key: jax.Array) -> tuple[jax.Array, Metrics]:
            policy, value = agent(networks, batch.pixels, batch.state)
            loss, metrics = policy_loss(policy, batch, config, key)
            if config.clip_value:
                error = clipped_value_loss(value, batch, config.clip_coef)
            else:
                error = value_loss(value, batch.returns, batch.weight)
            metrics |= {"loss/value": error} | policy_metrics(policy.std)
            return loss + config.vf_coef * error, metrics

        networks, opt_state, update_metrics = update(
            config,
            loss,
            state.networks,
            state.opt_state,
            experience,
            config.update_epochs,
            key,
            iteration,
            target_kl=config.target_kl,
        )
        state = state.replace(networks=networks, opt_state=opt_state)
        rate = Optimizer(config).learning_rate(iteration)
        return state, metrics | update_metrics | {"learning_rate": rate}
