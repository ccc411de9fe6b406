"""Phasic policy gradient (Cobbe et al., arXiv 2009.04416)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import jax

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, check_count, check_positive
from pixelbrax_jax.agents.on_policy import phasic
from pixelbrax_jax.agents.on_policy.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.experience import gather
from pixelbrax_jax.agents.on_policy.losses import (
    Batch,
    Metrics,
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

LAYOUTS = ("dual", "detach", "shared")


@dataclass(frozen=True)
class PPGConfig(TrainConfig):
    """Settings of PPG."""

    layout: str = "dual"
    """``dual`` encoders; or one, ``shared``, or of which values ``detach`` in policy phases."""
    policy_epochs: int = 1
    """E_pi, passes over a rollout for the policy."""
    value_epochs: int = 1
    """E_V, passes over a rollout for the value."""
    vf_coef: float = 1.0
    """Weight of the value loss, half the mean squared error."""
    num_policy_phases: int = 16
    """N_pi, rollouts between auxiliary phases, which learn from all of them."""
    aux_epochs: int = 4
    """E_aux, passes over the buffer."""
    aux_minibatches: int = 16
    """Minibatches of such a pass, a multiple of N_pi."""
    beta_clone: float = 1.0
    """Weight of KL(old policy || policy) in the auxiliary phase."""
    aux_value_coef: float = 1.0
    """Weight of the separate critic's loss in the auxiliary phase."""

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        super().__post_init__()
        check_choice("layout", self.layout, LAYOUTS)
        check_positive_int("policy_epochs", self.policy_epochs)
        check_positive_int("value_epochs", self.value_epochs)
        check_count("aux_epochs", self.aux_epochs)
        for name in ("vf_coef", "beta_clone", "aux_value_coef"):
            check_positive(name, getattr(self, name), or_zero=True)
        phasic.check_phases(self, self.num_policy_phases, self.aux_epochs, self.aux_minibatches)
        if self.layout != "dual" and self.policy_epochs != self.value_epochs:
            raise ValueError(
                f"policy_epochs={self.policy_epochs} and value_epochs={self.value_epochs} may "
                f"differ with layout='dual' alone, got {self.layout!r}: Adam would move what both "
                "share in passes of one of them."
            )
        if self.state_critic and self.layout != "dual":
            raise ValueError(
                f"state_critic needs layout='dual', got {self.layout!r}: no encoder is shared."
            )


@dataclass(frozen=True)
class PPG(Algorithm):
    """PPG with its settings, in the given environments."""

    config: PPGConfig
    name: ClassVar[str] = "ppg"
    config_class: ClassVar[type[TrainConfig]] = PPGConfig

    @property
    def num_phases(self) -> int:
        """As ``Algorithm.num_phases``."""
        return self.config.num_policy_phases if self.config.aux_epochs else 0

    @cached_property
    def agent(self) -> ActorCritic:
        """Its networks."""
        return ActorCritic(
            self.config,
            self.envs,
            shared=self.config.layout != "dual",
            detach_value=self.config.layout == "detach",
            has_value=True,
        )

    @under_default_flags
    def init(self, key: jax.Array, env_params: EnvParams) -> TrainState:
        """As ``Algorithm.init``, with an empty buffer."""
        state = super().init(key, env_params)
        decide = self.agent.decide(state.networks)
        state = phasic.with_buffer(
            self.config, self.envs, state, env_params, decide, self.config.num_policy_phases
        )
        return state.replace(aux_opt_state=Optimizer(self.config).init(state.networks))

    @under_default_flags
    def iterate(self, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """Learn as PPO does (the policy phase), and remember the rollout."""
        config, agent = self.config, self.agent
        key, iteration = update_key(state), state.iteration
        state, experience, metrics = gather(
            config, self.envs, state, env_params, agent.decide(state.networks)
        )

        def improve_policy(
            networks: Networks, batch: Batch, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            policy, _ = agent(networks, batch.pixels, batch.state)
            loss, metrics = policy_loss(policy, batch, config, key)
            return loss, metrics | policy_metrics(policy.std)

        def improve_value(
            networks: Networks, batch: Batch, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            del key
            _, value = agent(networks, batch.pixels, batch.state)
            error = value_loss(value, batch.returns, batch.weight)
            return config.vf_coef * error, {"loss/value": error}

        def improve_both(
            networks: Networks, batch: Batch, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            loss, metrics = improve_policy(networks, batch, key)
            error, value_metrics = improve_value(networks, batch, key)
            return loss + error, metrics | value_metrics

        # Passes that both make are made together, then those that one makes alone.
        shared_epochs = min(config.policy_epochs, config.value_epochs)
        networks, opt_state = state.networks, state.opt_state
        value_network = "critic" if config.layout == "dual" else "actor"
        plan = (
            (improve_both, shared_epochs, tuple(networks)),
            (improve_policy, config.policy_epochs - shared_epochs, ("actor",)),
            (improve_value, config.value_epochs - shared_epochs, (value_network,)),
        )
        for part, (loss, num_epochs, learners) in enumerate(plan):
            if num_epochs:
                # Far from the numbers of passes, by which keys are split.
                part_key = key if part == 0 else jax.random.fold_in(key, 2**31 + part)
                learning = {name: opt_state[name] for name in learners}
                networks, learning, update_metrics = update(
                    config, loss, networks, learning, experience, num_epochs, part_key, iteration
                )
                opt_state = opt_state | learning
                metrics |= update_metrics
        slot = iteration % config.num_policy_phases
        state = state.replace(
            networks=networks,
            opt_state=opt_state,
            buffer=phasic.remember(state.buffer, slot, experience),
        )
        return state, metrics | {"learning_rate": Optimizer(config).learning_rate(iteration)}

    @under_default_flags
    def auxiliary(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """Distil values into the actor's encoder, and keep its policy."""
        config, agent = self.config, self.agent

        def loss(
            networks: Networks, chunk: phasic.Chunk, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            del key
            critic_coef = config.aux_value_coef if config.layout == "dual" else None
            _, loss, metrics = phasic.value_loss_with_kept_policy(
                agent, networks, chunk, config.beta_clone, critic_coef
            )
            return loss, metrics

        return phasic.auxiliary_phase(
            config,
            state,
            lambda networks, pixels: agent.actor(networks["actor"], pixels).policy,
            loss,
            config.aux_epochs,
            config.aux_minibatches,
        )
