"""Phasic policy gradient (Cobbe et al., arXiv 2009.04416)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax

from pixelbrax_jax.agents.algorithms.ppo import ActorCritic, epochs
from pixelbrax_jax.agents.core import algorithm, phasic
from pixelbrax_jax.agents.core.algorithm import Algorithm, TrainState, environments, train_function
from pixelbrax_jax.agents.core.config import TrainConfig, check_count, check_positive
from pixelbrax_jax.agents.core.losses import Batch, Metrics, mean, policy_loss, value_loss
from pixelbrax_jax.agents.core.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.core.rollout import Environments
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
        """Checks the settings.

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


def make_train(
    config: PPGConfig,
    envs: Environments | None = None,
    env_params: EnvParams | None = None,
) -> Callable[[jax.Array], tuple[TrainState, Metrics]]:
    """A whole run as a pure function ``train(key) -> (state, metrics)``; see `train_function`.

    Args:
        config: settings.
        envs: environments of your own; None makes those that ``config`` names.
        env_params: of those.

    Raises:
        ValueError: one of the two is given without the other.
    """
    envs, env_params = environments(config, envs, env_params)
    return train_function(make_ppg(config, envs), env_params)


def make_ppg(config: PPGConfig, envs: Environments) -> Algorithm:
    """PPG in the given environments."""
    dual = config.layout == "dual"
    agent = ActorCritic(
        config, envs, shared=not dual, detach_value=config.layout == "detach", has_value=True
    )

    def init(key: jax.Array, env_params: EnvParams) -> TrainState:
        state = algorithm.begin(config, envs, agent.init, key, env_params)
        decide = agent.decide(state.networks)
        return phasic.begin_phases(
            config, envs, state, env_params, decide, config.num_policy_phases
        )

    def iterate(state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """The policy phase: PPO, and the rollout is remembered."""
        key, before = algorithm.update_key(state), state.iteration
        state, rollout, advantage, returns, metrics = algorithm.play(
            config, envs, state, env_params, agent.decide(state.networks)
        )

        def improve_policy(
            networks: Networks, batch: Batch, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            policy, _ = agent(networks, batch.pixels, batch.state)
            loss, facts = policy_loss(policy, batch, config, key)
            return loss, facts | algorithm.policy_metrics(policy.std)

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
            loss, facts = improve_policy(networks, batch, key)
            more, more_facts = improve_value(networks, batch, key)
            return loss + more, facts | more_facts

        # Passes that both make are made together, then those that one makes alone.
        together = min(config.policy_epochs, config.value_epochs)
        networks, moments = state.networks, state.moments
        plan = (
            (improve_both, together, tuple(networks)),
            (improve_policy, config.policy_epochs - together, ("actor",)),
            (improve_value, config.value_epochs - together, ("critic" if dual else "actor",)),
        )
        for part, (loss, number, learners) in enumerate(plan):
            if number:
                # Far from the numbers of passes, by which keys are split.
                part_key = key if part == 0 else jax.random.fold_in(key, 2**31 + part)
                experience = (rollout, advantage, returns)
                learning = {name: moments[name] for name in learners}
                networks, learning, facts = epochs(
                    config, loss, networks, learning, experience, number, part_key, before
                )
                moments = moments | learning
                metrics |= facts
        slot = before % config.num_policy_phases
        state = state.replace(
            networks=networks,
            moments=moments,
            buffer=phasic.remember(state.buffer, slot, rollout, returns),
        )
        return state, metrics | {"learning_rate": Optimizer(config).learning_rate(before)}

    def auxiliary(state: TrainState) -> tuple[TrainState, Metrics]:
        """Values are distilled into the actor's encoder, and its policy is kept."""

        def loss(
            networks: Networks, chunk: phasic.Chunk, key: jax.Array
        ) -> tuple[jax.Array, Metrics]:
            del key
            output = agent.actor(networks["actor"], chunk.pixels)
            error = value_loss(output.value, chunk.returns, chunk.weight)
            kl = mean(chunk.policy.kl_to(output.policy), chunk.weight)
            loss = error + config.beta_clone * kl
            facts = {"auxiliary/value_loss": error, "auxiliary/kl": kl}
            if dual:
                value = agent.critic(networks["critic"], chunk.pixels, chunk.state)
                critic_error = value_loss(value, chunk.returns, chunk.weight)
                loss += config.aux_value_coef * critic_error
                facts["auxiliary/critic_loss"] = critic_error
            return loss, facts

        return phasic.auxiliary_phase(
            config,
            state,
            lambda networks, pixels: agent.actor(networks["actor"], pixels).policy,
            loss,
            config.aux_epochs,
            config.aux_minibatches,
        )

    phases = config.num_policy_phases if config.aux_epochs else 0
    return Algorithm("ppg", config, envs, init, iterate, agent.act, auxiliary, phases)
