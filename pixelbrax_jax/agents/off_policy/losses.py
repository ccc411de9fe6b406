"""Terms of off-policy losses: exploration noise, Q functions and their targets."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

LARGEST_ACTION = 1.0 - 1e-6
"""Bound of the actions in updates, at which ``tanh`` has a gradient."""


def noisy(action: jax.Array, std: Any, key: jax.Array, clip: float | None = None) -> jax.Array:
    """Add normal noise, within +- ``clip``, to (B, A) actions, and clip the result to [-1, 1].

    The gradient passes the bounds (the truncated normal of DrQ-v2's code, arXiv 2107.09645).
    """
    noise = std * jax.random.normal(key, action.shape)
    if clip is not None:
        noise = jnp.clip(noise, -clip, clip)
    noised = action + noise
    bounded = jnp.clip(noised, -LARGEST_ACTION, LARGEST_ACTION)
    return noised + jax.lax.stop_gradient(bounded - noised)


def atoms(v_min: float, v_max: float, num_atoms: int) -> jax.Array:
    """Return the (M,) float32 values of a categorical distribution's atoms."""
    return jnp.linspace(v_min, v_max, num_atoms, dtype=jnp.float32)


def projected(probabilities: jax.Array, values: jax.Array, support: jax.Array) -> jax.Array:
    """Project (..., M) probabilities onto (M,) atoms (C51; Bellemare et al., arXiv 1707.06887).

    Each of (..., M) values, clipped to the atoms' range, gives its probability to the two equally
    spaced atoms beside it, so that the mean stays.
    """
    spacing = support[1] - support[0]
    values = jnp.clip(values, support[0], support[-1])
    distance = jnp.abs(values[..., None] - support) / spacing
    share = jnp.clip(1.0 - distance, 0.0, 1.0)
    return jnp.sum(probabilities[..., None] * share, -2)
