"""Proximal policy optimisation (Schulman et al., arXiv 1707.06347)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.core import algorithm
from pixelbrax_jax.agents.core.algorithm import Algorithm, TrainState, environments, train_function
from pixelbrax_jax.agents.core.config import TrainConfig, check_positive
from pixelbrax_jax.agents.core.distributions import Normal
from pixelbrax_jax.agents.core.losses import (
    Batch,
    Metrics,
    batch_at,
    clipped_value_loss,
    policy_loss,
    value_loss,
)
from pixelbrax_jax.agents.core.networks import Actor, ActorOutput, Critic
from pixelbrax_jax.agents.core.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.core.rollout import Decision, Environments, Rollout, minibatch_times
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
        """Checks the settings.

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


def make_train(
    config: PPOConfig,
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
    return train_function(make_ppo(config, envs), env_params)


def make_ppo(config: PPOConfig, envs: Environments) -> Algorithm:
    """PPO in the given environments."""
    agent = ActorCritic(config, envs, shared=config.layout == "shared")

    def init(key: jax.Array, env_params: EnvParams) -> TrainState:
        return algorithm.begin(config, envs, agent.init, key, env_params)

    def iterate(state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        key = algorithm.update_key(state)
        rate = Optimizer(config).learning_rate(state.iteration)
        decide = agent.decide(state.networks)
        before = state.iteration
        state, rollout, advantage, returns, metrics = algorithm.play(
            config, envs, state, env_params, decide
        )

        def loss(networks: Networks, batch: Batch, key: jax.Array) -> tuple[jax.Array, Metrics]:
            policy, value = agent(networks, batch.pixels, batch.state)
            loss, facts = policy_loss(policy, batch, config, key)
            if config.clip_value:
                error = clipped_value_loss(value, batch, config.clip_coef)
            else:
                error = value_loss(value, batch.returns, batch.weight)
            facts |= {"loss/value": error} | algorithm.policy_metrics(policy.std)
            return loss + config.vf_coef * error, facts

        networks, moments, facts = epochs(
            config,
            loss,
            state.networks,
            state.moments,
            (rollout, advantage, returns),
            config.update_epochs,
            key,
            before,
            target_kl=config.target_kl,
        )
        state = state.replace(networks=networks, moments=moments)
        return state, metrics | facts | {"learning_rate": rate}

    return Algorithm("ppo", config, envs, init, iterate, agent.act)


class ActorCritic:
    """An actor, and a critic of its own unless they share the encoder."""

    def __init__(
        self,
        config: TrainConfig,
        envs: Environments,
        shared: bool,
        detach_value: bool = False,
        has_value: bool = False,
    ) -> None:
        """Makes the networks.

        Args:
            config: settings.
            envs: tells the shapes of observations and actions.
            shared: whether the critic is the actor's value head.
            detach_value: whether a shared value leaves the encoder alone.
            has_value: whether the actor has a value head although the critic is another network.

        Raises:
            ValueError: the environments are not what the settings say.
        """
        algorithm.check_environments(config, envs)
        self._envs = envs
        self._shared = shared
        self._detach = detach_value
        self._actor = Actor(
            config.encoder,
            envs.env.action_size,
            config.policy,
            config.initial_std,
            has_value=shared or has_value,
        )
        self._critic = Critic(config.encoder, sees_state=config.state_critic)

    def init(self, key: jax.Array) -> Networks:
        """Fresh parameters."""
        spec = self._envs.env.obs_spec
        spec = spec if isinstance(spec, dict) else {"pixels": spec}
        inputs: dict[str, Any] = {
            name: jnp.zeros((1, *s.shape), s.dtype) for name, s in spec.items()
        }
        actor_key, critic_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
        networks = {"actor": self._actor.init(actor_key, inputs["pixels"])}
        if not self._shared:
            networks["critic"] = self._critic.init(
                critic_key, inputs["pixels"], inputs.get("state")
            )
        return networks

    def actor(self, params: Any, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """What the actor says of (B, H, W, 3 K) pixels."""
        output: ActorOutput = self._actor.apply(params, pixels, detach_value)  # type: ignore[assignment]
        return output

    def critic(self, params: Any, pixels: jax.Array, state: jax.Array | None) -> jax.Array:
        """(B,) values that the separate critic gives pixels, or states."""
        value: jax.Array = self._critic.apply(params, pixels, state)  # type: ignore[assignment]
        return value

    def __call__(
        self, networks: Networks, pixels: jax.Array, state: jax.Array | None
    ) -> tuple[Normal, jax.Array]:
        """Policy and value of (B, H, W, 3 K) pixels, and (B, S) states if the critic sees them."""
        output = self.actor(networks["actor"], pixels, self._detach)
        if not self._shared:
            return output.policy, self.critic(networks["critic"], pixels, state)
        return output.policy, output.value

    def decide(self, networks: Networks) -> Callable[..., Decision]:
        """What `rollout.collect` asks."""

        def decide(pixels: jax.Array, state: jax.Array | None, key: jax.Array) -> Decision:
            policy, value = self(networks, pixels, state)
            raw = policy.sample(key)
            return Decision(raw, policy.action(raw), policy.log_prob(raw), value)

        return decide

    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """Actions, (N, A); the mean ones without a key."""
        policy = self.actor(networks["actor"], pixels).policy
        return policy.action(policy.mean if key is None else policy.sample(key))


Loss = Callable[[Networks, Batch, jax.Array], tuple[jax.Array, Metrics]]


def epochs(
    config: TrainConfig,
    loss: Loss,
    networks: Networks,
    moments: Networks,
    experience: tuple[Rollout, jax.Array, jax.Array],
    number: int,
    key: jax.Array,
    iteration: jax.Array,
    *,
    target_kl: float | None = None,
) -> tuple[Networks, Networks, Metrics]:
    """Passes over a rollout in minibatches, with a step of the optimiser for each.

    Args:
        config: settings.
        loss: of networks, a batch and a key.
        networks: parameters.
        moments: of the optimiser; networks that have none here stay as they are.
        experience: rollout, advantages and returns.
        number: of passes.
        key: of this update alone.
        iteration: of the step size.
        target_kl: see ``PPOConfig``.

    Returns:
        Parameters, moments, and the mean of each metric over all minibatches that were used.
    """
    optimizer = Optimizer(config)

    def step(
        carry: tuple[Networks, Networks, jax.Array], inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[Any, tuple[Metrics, jax.Array]]:
        networks, moments, stopped = carry
        times, key = inputs
        batch = batch_at(config, *experience, times)
        gradients, facts = jax.grad(loss, has_aux=True)(networks, batch, key)
        # A gradient of 0 would not do: Adam goes on for a while in the direction it had.
        gradients = {name: gradients[name] for name in moments}
        new, new_moments, norms = optimizer.step(networks, moments, gradients, iteration)
        facts |= {f"grad_norm/{name}": norm for name, norm in norms.items()}
        if target_kl is None:
            return (new, new_moments, stopped), (facts, jnp.float32(1.0))
        # This minibatch is still used: its divergence is known only now.
        used = jnp.where(stopped, 0.0, 1.0)
        keep = jax.tree.map(
            lambda old, new: jnp.where(stopped, old, new), (networks, moments), (new, new_moments)
        )
        return (*keep, stopped | (facts["policy/approx_kl"] > target_kl)), (facts, used)

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        order = minibatch_times(
            jax.random.fold_in(key, 0), config.num_steps, config.num_envs, config.num_minibatches
        )
        keys = jax.random.split(jax.random.fold_in(key, 1), config.num_minibatches)
        return jax.lax.scan(step, carry, (order, keys))

    keys = jax.random.split(key, number)
    carry = (networks, moments, jnp.bool_(False))
    (networks, moments, _), (facts, used) = jax.lax.scan(epoch, carry, keys)
    facts = {name: jnp.sum(x * used) / jnp.sum(used) for name, x in facts.items()}
    return networks, moments, facts
