"""Adam for several networks, each with its own state and its own clipped gradient."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from pixelbrax_jax.agents.config import TrainConfig

Networks = dict[str, Any]
"""Parameters by name of the network."""


class Optimizer:
    """Steps along the gradients of several networks."""

    def __init__(self, config: TrainConfig) -> None:
        """Take its settings from ``config``."""
        self._config = config
        self._adam = optax.scale_by_adam(eps=config.adam_eps)

    def init(self, networks: Networks) -> Networks:
        """Return the optimiser's state of the named networks."""
        return {name: self._adam.init(params) for name, params in networks.items()}

    def learning_rate(self, iteration: jax.Array) -> jax.Array:
        """Return () float32, the step size in an iteration, a () uint32."""
        rate = jnp.float32(self._config.learning_rate)
        if self._config.anneal:
            rate *= jnp.maximum(0.0, 1.0 - iteration / self._config.num_iterations)
        return rate

    def step(
        self, networks: Networks, opt_state: Networks, gradients: Networks, iteration: jax.Array
    ) -> tuple[Networks, Networks, dict[str, jax.Array]]:
        """Step those networks that have gradients; the others stay.

        Args:
            networks: parameters.
            opt_state: of ``init``.
            gradients: of some of the networks.
            iteration: () uint32, of the step size.

        Returns:
            Parameters, the optimiser's state, and the gradients' global norms before clipping.
        """
        networks, opt_state, norms = dict(networks), dict(opt_state), {}
        rate = self.learning_rate(iteration)
        for name, gradient in gradients.items():
            norm = norms[name] = optax.tree.norm(gradient)
            if self._config.max_grad_norm:
                scale = jnp.minimum(1.0, self._config.max_grad_norm / (norm + 1e-6))
                gradient = jax.tree.map(lambda g, scale=scale: g * scale, gradient)
            updates, opt_state[name] = self._adam.update(gradient, opt_state[name])
            networks[name] = jax.tree.map(lambda p, u: p - rate * u, networks[name], updates)
        return networks, opt_state, norms
