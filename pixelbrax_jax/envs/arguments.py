"""Checks of the arguments of environments: actions and keys."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.flags import is_key


def check_action(action: Any, shape: tuple[int, ...]) -> jax.Array:
    """Return floating-point actions of the given shape as an array; raise for anything else."""
    action = jnp.asarray(action)
    if action.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {action.shape}.")
    if not jnp.issubdtype(action.dtype, jnp.floating):
        raise TypeError(f"action must be floating point in [-1, 1], got {action.dtype}.")
    return action


def check_key(key: jax.Array, shape: tuple[int, ...] = ()) -> None:
    """Raise TypeError unless ``key`` has typed PRNG keys of the given shape."""
    is_array = isinstance(key, jax.Array)
    if not (is_array and is_key(key.dtype)):
        # Not the type of an array, which is a tracer under jit.
        got = f"{key.dtype}{list(key.shape)}" if is_array else type(key).__name__
        raise TypeError(
            f"key must come from jax.random.key(seed), got {got}; jax.random.wrap_key_data "
            "converts a key of jax.random.PRNGKey."
        )
    if key.shape != shape:
        raise TypeError(f"key must have shape {shape}, got {key.shape}.")
