"""A point in the plane that is pushed to the middle."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance
from pixelbrax_jax.physics.mjx.resets import random_joints


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    return Start(random_joints(dynamics.model, key))


def _observe(seen: Snapshot) -> jax.Array:
    return joined(seen.qpos, seen.qvel)


def _reward(seen: Snapshot) -> jax.Array:
    """Return how near the mass is to the target, less for forces."""
    distance = jnp.linalg.norm(seen.geom_pos("target") - seen.geom_pos("pointmass"))
    radius = float(seen.model.geom("target").size[0])
    near = tolerance(distance, (0.0, radius), margin=radius)
    small = tolerance(seen.ctrl, margin=1.0, value_at_margin=0.0, sigmoid="quadratic")
    return near * (jnp.mean(small) + 4) / 5


TASKS = {"easy": Formulas(_start, _observe, _reward)}
