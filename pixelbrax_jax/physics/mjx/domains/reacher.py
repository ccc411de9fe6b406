"""A planar arm of two links that reaches for a target."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance
from pixelbrax_jax.physics.mjx.resets import random_joints
from pixelbrax_jax.physics.opengl import mujoco


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions, and a target 5 to 20 cm away from the shoulder."""
    joints, angle, radius = jax.random.split(key, 3)
    model = dynamics.model
    angle = jax.random.uniform(angle, (), minval=0.0, maxval=2 * jnp.pi)
    radius = jax.random.uniform(radius, (), minval=0.05, maxval=0.20)
    height = float(model.geom("target").pos[2])
    target = jnp.stack([radius * jnp.sin(angle), radius * jnp.cos(angle), height])
    return Start(random_joints(model, joints), target=target)


def _to_target(seen: Snapshot) -> jax.Array:
    """Return (2,) metres, the vector from the finger to the target in the plane."""
    return (seen.target - seen.geom_pos("finger"))[:2]


def _observe(seen: Snapshot) -> jax.Array:
    return joined(seen.qpos, _to_target(seen), seen.qvel)


def _reward(seen: Snapshot) -> jax.Array:
    """Return 1 if finger and target touch, else 0."""
    reach = sum(float(seen.model.geom(name).size[0]) for name in ("target", "finger"))
    return tolerance(jnp.linalg.norm(_to_target(seen)), (0.0, reach))


def _resize_target(model: mujoco.MjModel, *, radius: float) -> None:
    model.geom("target").size[0] = radius


def _task(radius: float) -> Formulas:
    edit = partial(_resize_target, radius=radius)
    return Formulas(_start, _observe, _reward, edit=edit, movable=("target",))


TASKS = {"easy": _task(0.05), "hard": _task(0.015)}
