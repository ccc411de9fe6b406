"""Normal distributions of actions, with an optional ``tanh``."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

_LOG_2PI = 1.8378770664093453


class Normal(struct.PyTreeNode):
    """Independent normal distributions of actions before ``action`` and the environment's clipping.

    Probabilities refer to these actions, because those of clipped ones would bias the gradient.

    Attributes:
        mean, std: (..., A) float32.
        squash: static; whether the action is ``tanh(unclipped)``.
    """

    mean: jax.Array
    std: jax.Array
    squash: bool = struct.field(pytree_node=False)

    def sample(self, key: jax.Array) -> jax.Array:
        """Sample (..., A) unclipped actions."""
        return self.mean + self.std * jax.random.normal(key, self.mean.shape)

    def action(self, unclipped: jax.Array) -> jax.Array:
        """Map unclipped actions to the actions for the environment."""
        return jnp.tanh(unclipped) if self.squash else unclipped

    def log_prob(self, unclipped: jax.Array) -> jax.Array:
        """Return the (...) log density of ``action(unclipped)``."""
        scaled = (unclipped - self.mean) / self.std
        log_prob = -0.5 * scaled**2 - jnp.log(self.std) - 0.5 * _LOG_2PI
        if self.squash:
            log_prob -= _log_slope(unclipped)
        return log_prob.sum(-1)

    def entropy(self, key: jax.Array) -> jax.Array:
        """Return the (...) entropy of the action in nats, with ``squash`` from one sample."""
        entropy = (jnp.log(self.std) + 0.5 * (1.0 + _LOG_2PI)).sum(-1)
        if self.squash:
            entropy += _log_slope(self.sample(key)).sum(-1)
        return entropy

    def kl_to(self, new: Normal) -> jax.Array:
        """Return the (...) divergence KL(self || new) in nats, equal with and without ``tanh``."""
        distance = (self.std**2 + (self.mean - new.mean) ** 2) / (2.0 * new.std**2)
        return (jnp.log(new.std) - jnp.log(self.std) + distance - 0.5).sum(-1)


def _log_slope(unclipped: jax.Array) -> jax.Array:
    """Return ``log(1 - tanh^2 u)``, in the stable form of arXiv 1801.01290, appendix C."""
    return 2.0 * (jnp.log(2.0) - unclipped - jax.nn.softplus(-2.0 * unclipped))
