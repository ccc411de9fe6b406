"""A pendulum with a weak motor."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance

_COSINE_BOUND = math.cos(math.radians(8))


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    return Start(jax.random.uniform(key, (dynamics.model.nq,), minval=-jnp.pi, maxval=jnp.pi))


def _observe(seen: Snapshot) -> jax.Array:
    """Return cosine and sine of the angle, and the velocity."""
    pole = seen.xmat("pole")
    return joined(pole[2, 2], pole[0, 2], seen.qvel)


def _reward(seen: Snapshot) -> jax.Array:
    """Return 1 within 8 degrees of upright, else 0."""
    return tolerance(seen.xmat("pole")[2, 2], (_COSINE_BOUND, 1.0))


TASKS = {"swingup": Formulas(_start, _observe, _reward)}
