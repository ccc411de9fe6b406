"""Actor and critic networks, separate or with a shared encoder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.networks.encoders import ENCODERS, dense
from pixelbrax_jax.agents.train_state import Networks

LOG_STD_RANGE = (-5.0, 2.0)
"""Range to which the logarithm of a standard deviation is clipped."""

POLICIES = ("gaussian", "tanh_gaussian", "deacrep")


class ActorOutput(struct.PyTreeNode):
    """An actor's policy, (B,) value or None, and (B, F) features of the encoder."""

    policy: Normal
    value: Any
    features: jax.Array


class Actor(nn.Module):
    """An encoder with a policy head and an optional value head.

    * ``"gaussian"``: the mean is linear in the features. Each action has one log standard
      deviation, clipped to [-5, 2], which is that of ``initial_std`` at first.
    * ``"tanh_gaussian"``: the same, but the action is the ``tanh`` of the sample.
    * ``"deacrep"`` (Garcin et al.'s code, behind arXiv 2502.00021): the mean is ``tanh`` of a
      linear layer, the standard deviation ``softplus`` of another one, clipped to [-10, 2], plus
      0.001.
    """

    encoder: str
    action_size: int
    policy: str
    initial_std: float = 1.0
    has_value: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """Map (B, H, W, C) uint8 pixels; ``detach_value`` stops value gradients at the encoder."""
        features = ENCODERS[self.encoder]()(pixels)
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
    """A value network of the pixels or, with ``sees_state``, of the simulator's state."""

    encoder: str
    sees_state: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Map (B, H, W, C) uint8 pixels or (B, S) float32 states to (B,) float32 values."""
        if self.sees_state:
            # The normalised output of the first layer does not depend on the scale of the state.
            features = jnp.tanh(nn.LayerNorm()(dense(256)(state)))
            features = nn.relu(dense(256)(features))
        else:
            features = ENCODERS[self.encoder]()(pixels)
        return dense(1, 1.0, "value")(features)[..., 0]


@dataclass(frozen=True)
class ActorCritic:
    """An actor with critic or value head; ``detach_value`` stops its gradients at the encoder."""

    actor_module: Actor
    critic_module: Critic | None = None
    detach_value: bool = False

    def init(self, key: jax.Array, pixels: Any, state: Any) -> Networks:
        """Sample initial parameters; ``pixels`` and ``state`` are ``jax.ShapeDtypeStruct``."""
        pixels, state = (s and jnp.zeros((1, *s.shape), s.dtype) for s in (pixels, state))
        networks = {"actor": self.actor_module.init(jax.random.fold_in(key, 0), pixels)}
        if self.critic_module is not None:
            critic_key = jax.random.fold_in(key, 1)
            networks["critic"] = self.critic_module.init(critic_key, pixels, state)
        return networks

    def actor(self, params: Any, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """Apply the actor to (B, H, W, 3 K) pixels."""
        output: Any = self.actor_module.apply(params, pixels, detach_value)
        return output

    def critic(self, params: Any, pixels: jax.Array, state: jax.Array | None) -> jax.Array:
        """Return (B,) values from the separate critic."""
        assert self.critic_module is not None
        value: Any = self.critic_module.apply(params, pixels, state)
        return value

    def __call__(
        self, networks: Networks, pixels: jax.Array, state: jax.Array | None
    ) -> tuple[Normal, jax.Array]:
        """Return policy and (B,) values for (B, H, W, 3 K) pixels and (B, S) states or None."""
        output = self.actor(networks["actor"], pixels, self.detach_value)
        if self.critic_module is None:
            return output.policy, output.value
        return output.policy, self.critic(networks["critic"], pixels, state)
