"""Adam for several networks, each with its own state and its own clipped gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.train_state import Metrics, Networks


class Optimizer:
    """Steps along the gradients of several networks, by the settings of ``config``."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._adam = optax.scale_by_adam(eps=config.adam_eps)

    def init(self, networks: Networks) -> Networks:
        """Return the optimiser's state of the named networks."""
        return {name: self._adam.init(params) for name, params in networks.items()}

    def learning_rate(self, iteration: jax.Array) -> jax.Array:
        """Return () float32, the step size in an iteration, a () uint32."""
        rate = jnp.float32(self._config.learning_rate)
        if self._config.anneal:
            # Rounding may make the fraction negative, which optax.linear_schedule lets pass.
            rate *= jnp.maximum(0.0, 1.0 - iteration / self._config.num_iterations)
        return rate

    def step(
        self, networks: Networks, opt_state: Networks, gradients: Networks, iteration: jax.Array
    ) -> tuple[Networks, Networks, Metrics]:
        """Step those networks that have gradients; the others stay.

        Returns:
            Parameters, the optimiser's state, and the gradients' global norms before clipping.
        """
        networks, opt_state, norms = dict(networks), dict(opt_state), {}
        rate = self.learning_rate(iteration)
        for name, gradient in gradients.items():
            norm = norms[name] = optax.tree.norm(gradient)
            if self._config.max_grad_norm:
                # As PyTorch clips; optax.clip_by_global_norm has no 1e-6.
                scale = jnp.minimum(1.0, self._config.max_grad_norm / (norm + 1e-6))
                gradient = jax.tree.map(lambda g, scale=scale: g * scale, gradient)
            updates, opt_state[name] = self._adam.update(gradient, opt_state[name])
            networks[name] = jax.tree.map(lambda p, u: p - rate * u, networks[name], updates)
        return networks, opt_state, norms
