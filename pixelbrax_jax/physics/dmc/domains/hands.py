"""Bodies that catch, turn or carry another one: ball in cup, finger and manipulator."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.dmc.formulas import free_of_contact, start_free_of_contact, tolerance
from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import Formulas, Snapshot, Start, joined, observe_joints
from pixelbrax_jax.physics.mujoco.opengl import mujoco

_FINGER_SPEED = 15.0

_OUT_OF_REACH = ("ground", "proximal_decoration", "proximal", "spinner_decoration")
"""The finger is 37.1 cm long, and its hinge is 40 cm from the ground and from the spinner's: only
the fingertip and the spinner's caps can touch."""

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


def _start_cup(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample a contact-free position of the ball; the cup is at rest in the middle."""
    model = dynamics.model

    def sample(key: jax.Array, before: Start) -> Start:
        del before
        low, high = jnp.array([-0.2, 0.2]), jnp.array([0.2, 0.5])
        place = jax.random.uniform(key, (2,), minval=low, maxval=high)
        qpos = jnp.asarray(model.qpos0, jnp.float32)
        return Start(qpos.at[jnp.array(_positions(model, "ball_x", "ball_z"))].set(place))

    return free_of_contact(dynamics, key, sample)


def _reward_cup(seen: Snapshot) -> jax.Array:
    """Return 1 while the ball is inside the target in the cup, else 0."""
    offset = jnp.abs(seen.site_pos("target") - seen.xpos("ball"))
    size = seen.model.site("target").size - seen.model.geom("ball").size[0]
    return jnp.where((offset[0] < size[0]) & (offset[2] < size[2]), 1.0, 0.0)


def _start_turn(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions, and a target on the circle that the body's tip can reach."""
    model = dynamics.model
    angle_key, pose_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, (), minval=-jnp.pi, maxval=jnp.pi)
    radius = float(model.geom("cap1").size.sum())
    direction = jnp.stack([jnp.sin(angle), 0.0, jnp.cos(angle)])
    place = jnp.asarray(model.body("spinner").pos, jnp.float32) + radius * direction
    return start_free_of_contact(dynamics, pose_key).replace(target=place)


def _from_hinge(seen: Snapshot, place: jax.Array) -> jax.Array:
    """Return (2,) metres, x and z of a position relative to the spinner's hinge."""
    return (place - seen.sensor("spinner"))[jnp.array([0, 2])]


def _observe_spin(seen: Snapshot) -> jax.Array:
    """Return positions, velocities and touch.

    * ``sensor("proximal", "distal")``
    * ``2`` from the spinner's hinge to its tip: x and z, m
    * ``sensor("proximal_velocity", "distal_velocity", "hinge_velocity")``
    * ``sensor("touchtop", "touchbottom")`` as log(1 + x)
    """
    return joined(
        seen.sensor("proximal", "distal"),
        _from_hinge(seen, seen.sensor("tip")),
        seen.sensor("proximal_velocity", "distal_velocity", "hinge_velocity"),
        jnp.log1p(seen.sensor("touchtop", "touchbottom")),
    )


def _distance(seen: Snapshot) -> jax.Array:
    """Return metres from the tip to the target's surface, negative inside."""
    offset = _from_hinge(seen, seen.state.target) - _from_hinge(seen, seen.sensor("tip"))
    return jnp.linalg.norm(offset) - float(seen.model.site("target").size[0])


def _observe_turn(seen: Snapshot) -> jax.Array:
    """Return the same, and where the target is.

    * ``_observe_spin``
    * ``2`` from the spinner's hinge to the target: x and z, m
    * ``1`` from the tip to the target's edge, m; negative inside
    """
    return joined(_observe_spin(seen), _from_hinge(seen, seen.state.target), _distance(seen))


def _reward_spin(seen: Snapshot) -> jax.Array:
    """Return 1 while the spinner turns at {-_FINGER_SPEED!g} rad/s or less, else 0."""
    return jnp.where(seen.sensor("hinge_velocity")[0] <= -_FINGER_SPEED, 1.0, 0.0)


def _reward_turn(seen: Snapshot) -> jax.Array:
    """Return 1 while the tip is inside the target, else 0.

    Inside: at most {model.site("target").size[0]!g} m from its center.
    """
    return jnp.where(_distance(seen) <= 0, 1.0, 0.0)


def _edit_spin(model: mujoco.MjModel) -> None:
    for site in ("target", "tip"):
        model.site(site).rgba[3] = 0.0
    model.dof_damping[model.joint("hinge").dofadr] = 0.03


def _resize_target(model: mujoco.MjModel, *, radius: float) -> None:
    model.site("target").size[0] = radius


def _start_manipulator(dynamics: Dynamics, key: jax.Array) -> Start:
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
    state = dynamics.state(qpos, target=_pose(model, target))
    seen = Snapshot(model, state, dynamics.first(state))
    place, axes = seen.site_pos("grasp"), seen.site_mat("grasp")
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


def _observe_manipulator(seen: Snapshot) -> jax.Array:
    """Return the arm, touch, and where hand, ball and target are.

    * ``2 * len(_ARM)`` sine and cosine of each position of {", ".join(_ARM)}
    * ``joint_vel(*_ARM)``
    * ``sensor(*_TOUCH)`` as log(1 + x)
    * ``4`` the hand: x and z (m), w and y of its quaternion
    * ``4`` the ball: the same
    * ``joint_vel(*_BALL)``
    * ``4`` the target: x and z (m), w and y of its quaternion
    """
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


def _reward_manipulator(seen: Snapshot) -> jax.Array:
    """Return ``tolerance(d, [0, {_NEAR!g}], margin={2 * _NEAR!g})``.

    d: metres from the ball to the target.
    """
    apart = jnp.linalg.norm(seen.site_pos("ball") - seen.site_pos(_TARGET))
    return tolerance(apart, (0.0, _NEAR), margin=2 * _NEAR)


_finger = partial(
    Formulas, substeps=2, out_of_reach=_OUT_OF_REACH, reads_forces=True, prefers_xla=True
)


def _turn(radius: float) -> Formulas:
    edit = partial(_resize_target, radius=radius)
    return _finger(_start_turn, _observe_turn, _reward_turn, edit=edit, movable=("target",))


TASKS = {
    "dmc_ball_in_cup_catch": Formulas(_start_cup, observe_joints, _reward_cup, substeps=10),
    "dmc_finger_spin": _finger(start_free_of_contact, _observe_spin, _reward_spin, edit=_edit_spin),
    "dmc_finger_turn_easy": _turn(0.07),
    "dmc_finger_turn_hard": _turn(0.03),
    "dmc_manipulator_bring_ball": Formulas(
        _start_manipulator,
        _observe_manipulator,
        _reward_manipulator,
        substeps=10,
        options={"max_contacts": _MAX_CONTACTS},
        target_body=_TARGET,
        reads_forces=True,
        # Everything moves in the plane y = 0; this is the wall behind it.
        out_of_reach=("background",),
    ),
}
