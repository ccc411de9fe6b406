"""A humanoid that stands, walks or runs in any direction."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, rising, tolerance
from pixelbrax_jax.physics.mjx.resets import free_of_contact, random_joints

_STAND_HEIGHT = 1.4


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample contact-free joint positions and root rotation."""
    return free_of_contact(dynamics, key, lambda key, _: Start(random_joints(dynamics.model, key)))


def _observe(seen: Snapshot) -> jax.Array:
    """Return joint positions, height, hands and feet, uprightness and velocities."""
    torso, frame = seen.xpos("torso"), seen.xmat("torso")
    limbs = ("left_hand", "left_foot", "right_hand", "right_foot")
    extremities = [(seen.xpos(limb) - torso) @ frame for limb in limbs]
    return joined(
        seen.qpos[7:],
        seen.xpos("head")[2],
        *extremities,
        frame[2],
        seen.sensor("torso_subtreelinvel"),
        seen.qvel,
    )


def _reward(seen: Snapshot, *, speed: float) -> jax.Array:
    """Return a product: head high, torso upright, little force, and the wanted speed."""
    standing = tolerance(seen.xpos("head")[2], (_STAND_HEIGHT, jnp.inf), margin=_STAND_HEIGHT / 4)
    upright = rising(seen.xmat("torso")[2, 2], 0.9, margin=1.9)
    small = tolerance(seen.ctrl, margin=1.0, value_at_margin=0.0, sigmoid="quadratic")
    stand = (4 + jnp.mean(small)) / 5 * standing * upright
    velocity = seen.sensor("torso_subtreelinvel")[:2]
    if speed == 0:
        return stand * jnp.mean(tolerance(velocity, margin=2.0))
    move = rising(jnp.linalg.norm(velocity), speed, margin=speed)
    return stand * (5 * move + 1) / 6


def _task(speed: float) -> Formulas:
    return Formulas(_start, _observe, partial(_reward, speed=speed), batch_last=False, substeps=5)


TASKS = {"stand": _task(0.0), "walk": _task(1.0), "run": _task(10.0)}
