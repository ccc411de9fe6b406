"""A planar arm with two fingers that brings a ball to a target."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance
from pixelbrax_jax.physics.mjx.resets import free_of_contact
from pixelbrax_jax.physics.opengl import mujoco

_ARM = (
    "arm_root",
    "arm_shoulder",
    "arm_elbow",
    "arm_wrist",
    "finger",
    "fingertip",
    "thumb",
    "thumbtip",
)
_BALL = ("ball_x", "ball_z", "ball_y")
_TOUCH = ("palm_touch", "finger_touch", "thumb_touch", "fingertip_touch", "thumbtip_touch")
_TARGET = "target_ball"

_IN_HAND, _AT_TARGET = 0.1, 0.1
"""Probabilities that a sample has the ball in the hand, and at the target; else it is anywhere."""

_MAX_CONTACTS = 24
"""Of 148 possible contacts random actions make at most 10; all 148 take three times as long."""

_NEAR = 0.01
"""Largest distance in metres between ball and target with full reward."""


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    return free_of_contact(dynamics, key, partial(_sample, dynamics))


def _sample(dynamics: Dynamics, key: jax.Array, before: Start) -> Start:
    """Sample the arm, a target, and the ball: in the hand, at the target, or anywhere and moving.

    A ball in the hand or at the target has the velocity of the sample ``before``, because DM
    Control samples again without resetting it.
    """
    model = dynamics.model
    keys = jax.random.split(key, 5)
    qpos = jnp.asarray(model.qpos0, jnp.float32)
    qpos = qpos.at[_positions(model, *_ARM)].set(_arm(model, keys[0]))
    qpos = qpos.at[_positions(model, "finger")].set(qpos[_positions(model, "thumb")])

    low, high = jnp.array([-0.4, 0.1, -jnp.pi]), jnp.array([0.4, 0.4, jnp.pi])
    target = jax.random.uniform(keys[1], (3,), minval=low, maxval=high)
    low, high = jnp.array([-0.5, 0.0, 0.0]), jnp.array([0.5, 0.7, 2 * jnp.pi])
    anywhere = jax.random.uniform(keys[2], (3,), minval=low, maxval=high)
    place, axes = dynamics.site(qpos, "grasp")
    in_hand = jnp.stack([place[0], place[2], jnp.pi - jnp.arctan2(axes[2, 0], axes[0, 0])])

    where = jax.random.uniform(keys[3])
    is_in_hand, is_fixed = where < _IN_HAND, where < _IN_HAND + _AT_TARGET
    ball = jnp.where(is_in_hand, in_hand, jnp.where(is_fixed, target, anywhere))
    qpos = qpos.at[_positions(model, *_BALL)].set(ball)

    x = int(model.joint("ball_x").dofadr[0])
    speed = jax.random.uniform(keys[4], minval=-5.0, maxval=5.0)
    assert before.qvel is not None
    qvel = before.qvel.at[x].set(jnp.where(is_fixed, before.qvel[x], speed))
    return Start(qpos, qvel, _pose(model, target))


def _positions(model: mujoco.MjModel, *joints: str) -> np.ndarray:
    return np.array([int(model.joint(name).qposadr[0]) for name in joints])


def _arm(model: mujoco.MjModel, key: jax.Array) -> jax.Array:
    """Sample the arm's joints uniformly in their range, or in [-pi, pi], radians."""
    rows = [model.joint(name).id for name in _ARM]
    limited = model.jnt_limited[rows].astype(bool)[:, None]
    low, high = np.where(limited, model.jnt_range[rows], [-np.pi, np.pi]).T.astype(np.float32)
    return jax.random.uniform(key, (len(rows),), minval=low, maxval=high)


def _pose(model: mujoco.MjModel, planar: jax.Array) -> jax.Array:
    """Return (7,), position and quaternion of the target for its x, z and angle about y."""
    x, z, angle = planar
    depth = float(model.body(_TARGET).pos[1])
    return jnp.stack([x, depth, z, jnp.cos(angle / 2), 0.0, jnp.sin(angle / 2), 0.0])


def _in_plane(seen: Snapshot, body: str) -> jax.Array:
    """Return (4,), x and z of a body, metres, and w and y of its quaternion."""
    return joined(seen.xpos(body)[np.array([0, 2])], seen.xquat(body)[np.array([0, 2])])


def _observe(seen: Snapshot) -> jax.Array:
    """Return sines and cosines of the arm, its velocities, touch, hand, ball and target."""
    arm = seen.joint_pos(*_ARM)
    return joined(
        jnp.stack([jnp.sin(arm), jnp.cos(arm)], axis=-1),
        seen.joint_vel(*_ARM),
        jnp.log1p(seen.sensor(*_TOUCH)),
        _in_plane(seen, "hand"),
        _in_plane(seen, "ball"),
        seen.joint_vel(*_BALL),
        _in_plane(seen, _TARGET),
    )


def _reward(seen: Snapshot) -> jax.Array:
    apart = jnp.linalg.norm(seen.site_pos("ball") - seen.site_pos(_TARGET))
    return tolerance(apart, (0.0, _NEAR), margin=2 * _NEAR)


TASKS = {
    "bring_ball": Formulas(
        _start,
        _observe,
        _reward,
        substeps=10,
        options={"max_contacts": _MAX_CONTACTS},
        target_body=_TARGET,
        reads_forces=True,
        # Everything moves in the plane y = 0; this is the wall behind it.
        out_of_reach=("background",),
    )
}
