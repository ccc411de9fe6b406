"""A policy and a value, of one network or of two."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.networks.actor import Actor, ActorOutput, Critic
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.rollout import Decision, Environments
from pixelbrax_jax.agents.optimizer import Networks


@dataclass(frozen=True)
class ActorCritic:
    """An actor, and a critic of its own unless they share the encoder.

    Attributes:
        config: settings.
        envs: environments, whose observations and actions the networks fit.
        shared: whether the critic is the actor's value head.
        detach_value: whether a shared value leaves the encoder alone.
        has_value: whether the actor has a value head although the critic is another network.
    """

    config: TrainConfig
    envs: Environments
    shared: bool
    detach_value: bool = False
    has_value: bool = False

    @cached_property
    def _actor(self) -> Actor:
        return Actor(
            self.config.encoder,
            self.envs.env.action_size,
            self.config.policy,
            self.config.initial_std,
            has_value=self.shared or self.has_value,
        )

    @cached_property
    def _critic(self) -> Critic:
        return Critic(self.config.encoder, sees_state=self.config.state_critic)

    def init(self, key: jax.Array) -> Networks:
        """Sample initial parameters."""
        spec = self.envs.env.obs_spec
        spec = spec if isinstance(spec, dict) else {"pixels": spec}
        inputs: dict[str, Any] = {
            name: jnp.zeros((1, *s.shape), s.dtype) for name, s in spec.items()
        }
        actor_key, critic_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
        networks = {"actor": self._actor.init(actor_key, inputs["pixels"])}
        if not self.shared:
            networks["critic"] = self._critic.init(
                critic_key, inputs["pixels"], inputs.get("state")
            )
        return networks

    def actor(self, params: Any, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """Return the actor's output for (B, H, W, 3 K) pixels."""
        output: ActorOutput = self._actor.apply(params, pixels, detach_value)  # type: ignore[assignment]
        return output

    def critic(self, params: Any, pixels: jax.Array, state: jax.Array | None) -> jax.Array:
        """Return (B,) values of the separate critic for pixels, or states."""
        value: jax.Array = self._critic.apply(params, pixels, state)  # type: ignore[assignment]
        return value

    def __call__(
        self, networks: Networks, pixels: jax.Array, state: jax.Array | None
    ) -> tuple[Normal, jax.Array]:
        """Return policy and value of (B, H, W, 3 K) pixels.

        Args:
            networks: parameters.
            pixels: (B, H, W, 3 K) uint8.
            state: (B, S) float32, if the critic sees it.
        """
        output = self.actor(networks["actor"], pixels, self.detach_value)
        if not self.shared:
            return output.policy, self.critic(networks["critic"], pixels, state)
        return output.policy, output.value

    def decide(self, networks: Networks) -> Callable[..., Decision]:
        """Return the function by which `rollout.collect` chooses actions."""

        def decide(pixels: jax.Array, state: jax.Array | None, key: jax.Array) -> Decision:
            policy, value = self(networks, pixels, state)
            unclipped = policy.sample(key)
            return Decision(unclipped, policy.action(unclipped), policy.log_prob(unclipped), value)

        return decide

    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """Return actions, (N, A); mean actions without a key."""
        policy = self.actor(networks["actor"], pixels).policy
        return policy.action(policy.mean if key is None else policy.sample(key))
