"""A policy and a value of pixels, of one network or of two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.networks.encoders import ENCODERS, dense, scaled
from pixelbrax_jax.agents.train_state import Networks

LOG_STD_RANGE = (-5.0, 2.0)
"""Between which logarithms of standard deviations are kept."""

POLICIES = ("gaussian", "tanh_gaussian", "deacrep")


class ActorOutput(struct.PyTreeNode):
    """What an actor says of a batch of observations.

    Attributes:
        policy: the distribution over actions.
        value: (B,) float32 of the actor's own value head; None if it has none.
        features: (B, F) float32 of the encoder.
    """

    policy: Normal
    value: Any
    features: jax.Array


class Actor(nn.Module):
    """Encoder, policy head and, if wanted, a value head.

    Policies:

    * ``"gaussian"``: mean linear in the features, one log standard deviation for each action,
      clipped to [-5, 2]; the environment clips the action.
    * ``"tanh_gaussian"``: the same, and the action is its ``tanh``.
    * ``"deacrep"``: as in Lyu et al.'s code for arXiv 2502.00021: mean ``tanh`` of a linear layer,
      standard deviation ``softplus`` of another one, clipped to [-10, 10], plus 0.001.

    Attributes:
        initial_std: of ``"gaussian"`` and ``"tanh_gaussian"``.
        has_value: whether there is a value head.
    """

    encoder: str
    action_size: int
    policy: str
    initial_std: float = 1.0
    has_value: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """Return the policy and value of (B, H, W, C) uint8 pixels.

        With ``detach_value`` the value's gradient stops before the encoder.
        """
        features = ENCODERS[self.encoder]()(scaled(pixels))
        mean = dense(self.action_size, 0.01, "mean")(features)
        if self.policy == "deacrep":
            mean = jnp.tanh(mean)
            spread = dense(self.action_size, 0.01, "spread")(features)
            std = jax.nn.softplus(jnp.clip(spread, -10.0, 2.0)) + 0.001
        else:
            start = nn.initializers.constant(math.log(self.initial_std))
            log_std = self.param("log_std", start, (self.action_size,))
            std = jnp.broadcast_to(jnp.exp(jnp.clip(log_std, *LOG_STD_RANGE)), mean.shape)
        value = None
        if self.has_value:
            seen = jax.lax.stop_gradient(features) if detach_value else features
            value = dense(1, 1.0, "value")(seen)[..., 0]
        policy = Normal(mean=mean, std=std, squash=self.policy == "tanh_gaussian")
        return ActorOutput(policy=policy, value=value, features=features)


class Critic(nn.Module):
    """The value of pixels, or of the simulator's state alone."""

    encoder: str
    sees_state: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Return (B,) float32 values of (B, H, W, C) uint8 pixels, or (B, S) float32 states."""
        if self.sees_state:
            # Normalising a first layer's output makes the scale of the state unimportant.
            features = jnp.tanh(nn.LayerNorm()(dense(256)(state)))
            features = nn.relu(dense(256)(features))
        else:
            features = ENCODERS[self.encoder]()(scaled(pixels))
        return dense(1, 1.0, "value")(features)[..., 0]


@dataclass(frozen=True)
class ActorCritic:
    """An actor, and a critic of its own unless they share the encoder.

    Attributes:
        actor_module: with a value head, if there is no critic module.
        critic_module: None where the critic is the actor's value head.
        detach_value: whether a shared value leaves the encoder alone.
    """

    actor_module: Actor
    critic_module: Critic | None = None
    detach_value: bool = False

    def init(self, key: jax.Array, pixels: Any, state: Any) -> Networks:
        """Sample initial parameters for observations of these ``jax.ShapeDtypeStruct``."""
        pixels, state = (s and jnp.zeros((1, *s.shape), s.dtype) for s in (pixels, state))
        networks = {"actor": self.actor_module.init(jax.random.fold_in(key, 0), pixels)}
        if self.critic_module is not None:
            critic_key = jax.random.fold_in(key, 1)
            networks["critic"] = self.critic_module.init(critic_key, pixels, state)
        return networks

    def actor(self, params: Any, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """Return the actor's output for (B, H, W, 3 K) pixels."""
        output: Any = self.actor_module.apply(params, pixels, detach_value)
        return output

    def critic(self, params: Any, pixels: jax.Array, state: jax.Array | None) -> jax.Array:
        """Return (B,) values of the critic of its own."""
        assert self.critic_module is not None
        value: Any = self.critic_module.apply(params, pixels, state)
        return value

    def __call__(
        self, networks: Networks, pixels: jax.Array, state: jax.Array | None
    ) -> tuple[Normal, jax.Array]:
        """Return policy and value of (B, H, W, 3 K) pixels and, if it is seen, (B, S) state."""
        output = self.actor(networks["actor"], pixels, self.detach_value)
        if self.critic_module is None:
            return output.policy, output.value
        return output.policy, self.critic(networks["critic"], pixels, state)

    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """Return actions, (B, A); mean actions without a key."""
        policy = self.actor(networks["actor"], pixels).policy
        return policy.action(policy.mean if key is None else policy.sample(key))
