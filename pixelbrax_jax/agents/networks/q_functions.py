"""A deterministic actor and two Q functions over the features of one encoder (DrQ-v2)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from pixelbrax_jax.agents.networks.encoders import dense


class Trunk(nn.Module):
    """A dense layer, LayerNorm and ``tanh``, which bound the inputs of later layers."""

    size: int

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Map (B, F) to (B, size)."""
        return jnp.tanh(nn.LayerNorm()(dense(self.size, 1.0)(features)))


class Head(nn.Module):
    """Two hidden layers, optionally with LayerNorm, and a linear layer."""

    hidden_dim: int
    outputs: int
    layer_norm: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, F) to (B, outputs)."""
        for _ in range(2):
            x = dense(self.hidden_dim, 1.0)(x)
            x = nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)
        return dense(self.outputs, 1.0)(x)


class DeterministicActor(nn.Module):
    """A policy whose action is the ``tanh`` of the output; exploration adds noise to it."""

    action_size: int
    feature_dim: int
    hidden_dim: int
    layer_norm: bool

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Map (B, F) features to (B, A)."""
        x = Trunk(self.feature_dim)(features)
        return Head(self.hidden_dim, self.action_size, self.layer_norm)(x)


class TwinQ(nn.Module):
    """Two Q functions with one trunk; each has one output, or one logit per atom."""

    outputs: int
    feature_dim: int
    hidden_dim: int
    layer_norm: bool

    @nn.compact
    def __call__(self, features: jax.Array, action: jax.Array) -> jax.Array:
        """Map (B, F) features and (B, A) actions to (2, B, outputs)."""
        x = jnp.concatenate([Trunk(self.feature_dim)(features), action], -1)
        heads = [Head(self.hidden_dim, self.outputs, self.layer_norm) for _ in range(2)]
        return jnp.stack([head(x) for head in heads])
