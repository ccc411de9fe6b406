"""A planar two-legged body that stands, walks or runs."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, rising, tolerance
from pixelbrax_jax.physics.mjx.resets import random_joints

_STAND_HEIGHT = 1.2


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions and the root's angle, without a check for contacts."""
    return Start(random_joints(dynamics.model, key))


def _observe(seen: Snapshot) -> jax.Array:
    """Return x axes of all bodies in the plane, the torso's height, and velocities."""
    axes = seen.xmats()[:, 0][:, jnp.array([0, 2])]
    return joined(axes, seen.xpos("torso")[2], seen.qvel)


def _reward(seen: Snapshot, *, speed: float) -> jax.Array:
    """Return standing height and uprightness, times the speed along x relative to the goal."""
    standing = tolerance(seen.xpos("torso")[2], (_STAND_HEIGHT, jnp.inf), margin=_STAND_HEIGHT / 2)
    stand = (3 * standing + (1 + seen.xmat("torso")[2, 2]) / 2) / 4
    if speed == 0:
        return stand
    x_speed = seen.sensor("torso_subtreelinvel")[0]
    move = rising(x_speed, speed, speed / 2, value_at_margin=0.5)
    return stand * (5 * move + 1) / 6


def _task(speed: float) -> Formulas:
    return Formulas(_start, _observe, partial(_reward, speed=speed), substeps=10)


TASKS = {"stand": _task(0.0), "walk": _task(1.0), "run": _task(8.0)}
