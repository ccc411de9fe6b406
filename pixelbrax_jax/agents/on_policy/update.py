"""Learning from one rollout: passes over it in minibatches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.on_policy.experience import Experience
from pixelbrax_jax.agents.on_policy.losses import Batch, Metrics, batch_at
from pixelbrax_jax.agents.on_policy.rollout import minibatch_times
from pixelbrax_jax.agents.optimizer import Networks, Optimizer

Loss = Callable[[Networks, Batch, jax.Array], tuple[jax.Array, Metrics]]


def update(
    config: TrainConfig,
    loss: Loss,
    networks: Networks,
    opt_state: Networks,
    experience: Experience,
    num_epochs: int,
    key: jax.Array,
    iteration: jax.Array,
    *,
    target_kl: float | None = None,
) -> tuple[Networks, Networks, Metrics]:
    """Pass over a rollout in minibatches, with a step of the optimiser for each.

    Args:
        config: settings.
        loss: of networks, a batch and a key.
        networks: parameters.
        opt_state: of the optimiser; networks that have none here stay as they are.
        experience: the rollout.
        num_epochs: number of passes.
        key: of this update alone.
        iteration: of the step size.
        target_kl: see ``PPOConfig``.

    Returns:
        Parameters, the optimiser's state, and the mean of each metric over all minibatches that
        were used.
    """
    optimizer = Optimizer(config)

    def step(
        carry: tuple[Networks, Networks, jax.Array], inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[Any, tuple[Metrics, jax.Array]]:
        networks, opt_state, stopped = carry
        times, key = inputs
        batch = batch_at(config, *experience, times)
        gradients, metrics = jax.grad(loss, has_aux=True)(networks, batch, key)
        # A gradient of 0 would not do: Adam goes on for a while in the direction it had.
        gradients = {name: gradients[name] for name in opt_state}
        new, new_opt_state, norms = optimizer.step(networks, opt_state, gradients, iteration)
        metrics |= {f"grad_norm/{name}": norm for name, norm in norms.items()}
        if target_kl is None:
            return (new, new_opt_state, stopped), (metrics, jnp.float32(1.0))
        # This minibatch is still used: its divergence is known only now.
        used = jnp.where(stopped, 0.0, 1.0)
        keep = jax.tree.map(
            lambda old, new: jnp.where(stopped, old, new),
            (networks, opt_state),
            (new, new_opt_state),
        )
        return (*keep, stopped | (metrics["policy/approx_kl"] > target_kl)), (metrics, used)

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        order = minibatch_times(
            jax.random.fold_in(key, 0), config.num_steps, config.num_envs, config.num_minibatches
        )
        keys = jax.random.split(jax.random.fold_in(key, 1), config.num_minibatches)
        return jax.lax.scan(step, carry, (order, keys))

    keys = jax.random.split(key, num_epochs)
    carry = (networks, opt_state, jnp.bool_(False))
    (networks, opt_state, _), (metrics, used) = jax.lax.scan(epoch, carry, keys)
    metrics = {name: jnp.sum(x * used) / jnp.sum(used) for name, x in metrics.items()}
    return networks, opt_state, metrics
