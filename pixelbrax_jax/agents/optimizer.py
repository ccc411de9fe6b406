"""Adam for several networks, each with its own state and clipped gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.train_state import Metrics, Networks


class Optimizer:
    """Applies Adam to several networks with the settings of ``config``."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._adam = optax.scale_by_adam(eps=config.adam_eps)

    def init(self, networks: Networks) -> Networks:
        """Return the initial optimiser state of the networks."""
        return {name: self._adam.init(params) for name, params in networks.items()}

    def learning_rate(self, iteration: jax.Array) -> jax.Array:
        """Return the () float32 step size of a () uint32 iteration."""
        rate = jnp.float32(self._config.learning_rate)
        if self._config.anneal:
            # Rounding can make the fraction negative; optax.linear_schedule does not clip it.
            rate *= jnp.maximum(0.0, 1.0 - iteration / self._config.num_iterations)
        return rate

    def step(
        self, networks: Networks, opt_state: Networks, gradients: Networks, iteration: jax.Array
    ) -> tuple[Networks, Networks, Metrics]:
        """Update the networks that have gradients; also return the norms of unclipped gradients."""
        networks, opt_state, norms = dict(networks), dict(opt_state), {}
        rate = self.learning_rate(iteration)
        for name, gradient in gradients.items():
            norm = norms[name] = optax.tree.norm(gradient)
            if self._config.max_grad_norm:
                # PyTorch's formula; optax.clip_by_global_norm has no 1e-6.
                scale = jnp.minimum(1.0, self._config.max_grad_norm / (norm + 1e-6))
                gradient = jax.tree.map(lambda g, scale=scale: g * scale, gradient)
            updates, opt_state[name] = self._adam.update(gradient, opt_state[name])
            networks[name] = jax.tree.map(lambda p, u: p - rate * u, networks[name], updates)
        return networks, opt_state, norms
