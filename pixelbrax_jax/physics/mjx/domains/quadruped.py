"""A four-legged body that walks or runs."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, rising
from pixelbrax_jax.physics.mjx.resets import random_rotation
from pixelbrax_jax.physics.opengl import mujoco

_LIFT = 0.01
"""Metres between two tested heights."""

_EPISODE = 20.0
"""Seconds of an episode; sets the size of the floor."""


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample any rotation, at the lowest contact-free height in whole centimetres.

    DM Control starts at height 0 and lifts the body until there is no contact. All distances from
    the floor grow with the height, so the height follows from the distances at height 0.
    """
    model = dynamics.model
    rotation = random_rotation(key)
    joints = jnp.asarray(model.qpos0[7:], jnp.float32)
    depth = -dynamics.clearance(joined(jnp.zeros(3), rotation, joints), "floor")
    height = _LIFT * jnp.ceil(jnp.maximum(depth, 0.0) / _LIFT)
    return Start(joined(jnp.zeros(2), height, rotation, joints))


def _hinges(model: mujoco.MjModel) -> list[str]:
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    return [model.joint(int(i)).name for i in np.flatnonzero(model.jnt_type == hinge)]


def _observe(seen: Snapshot) -> jax.Array:
    """Return hinges, activations, the torso's motion, and forces and torques at the toes."""
    kinds, hinges = mujoco.mjtSensor, _hinges(seen.model)
    return joined(
        seen.joint_pos(*hinges),
        seen.joint_vel(*hinges),
        seen.act,
        seen.sensor("velocimeter"),
        seen.xmat("torso")[2, 2],
        seen.sensors_of(kinds.mjSENS_GYRO, kinds.mjSENS_ACCELEROMETER),
        jnp.arcsinh(seen.sensors_of(kinds.mjSENS_FORCE, kinds.mjSENS_TORQUE)),
    )


def _reward(seen: Snapshot, *, speed: float) -> jax.Array:
    """Return uprightness times the speed along the torso's x axis, relative to the goal."""
    upright = rising(seen.xmat("torso")[2, 2], 1.0, margin=2.0)
    return upright * rising(seen.sensor("velocimeter")[0], speed, speed, value_at_margin=0.5)


def _task(speed: float) -> Formulas:
    return Formulas(
        _start,
        _observe,
        partial(_reward, speed=speed),
        batch_last=False,
        substeps=4,
        options={"floor_size": _EPISODE * speed},
        camera=2,
        reads_forces=True,
        starts_with_forces=True,
    )


TASKS = {"walk": _task(0.5), "run": _task(5.0)}
