"""Bodies that stand, walk, run or hop: cheetah, hopper, humanoid, quadruped and walker."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.dmc.formulas import (
    random_joints,
    random_rotation,
    rising,
    small_control,
    start_anywhere,
    start_free_of_contact,
    tolerance,
)
from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import (
    Formulas,
    Snapshot,
    Start,
    joined,
    observe_joints_from,
)
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.spatial import quat_to_mat

_CHEETAH_SPEED = 10.0
_CHEETAH_SETTLING_STEPS = 200

_HOPPER_HEIGHT = 0.6
_HOPPER_SPEED = 2.0

_HUMANOID_HEIGHT = 1.4

_QUADRUPED_LIFT = 0.01
"""Metres between two tested heights."""
_QUADRUPED_EPISODE = 20.0
"""Seconds of an episode; sets the size of the floor."""

_WALKER_HEIGHT = 1.2


def _start_cheetah(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample limited joints, then let the body fall for 200 physics steps.

    As in DM Control, the first step uses the forces of the model's default pose.
    """
    model = dynamics.model
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    joints = random_joints(model, key)
    # The root's hinge has no limit, so it is not sampled.
    limited = np.zeros(model.nq, bool)
    limited[model.jnt_qposadr[model.jnt_limited == 1]] = True
    qpos = jnp.where(limited, joints, model.qpos0) + (data.qpos - model.qpos0)
    state = dynamics.state(qpos, data.qvel)
    state, _ = dynamics.step(state, _CHEETAH_SETTLING_STEPS - 1)
    return Start(state.qpos, state.qvel)


def _reward_cheetah(seen: Snapshot) -> jax.Array:
    """Return ``rising(v, {_CHEETAH_SPEED!g}, margin={_CHEETAH_SPEED!g})``.

    v: velocity of the center of mass along x, m/s.
    """
    speed = seen.sensor("torso_subtreelinvel")[0]
    return rising(speed, _CHEETAH_SPEED, margin=_CHEETAH_SPEED)


def _observe_hopper(seen: Snapshot) -> jax.Array:
    """Return joint positions without x, velocities and touch.

    * ``qpos[1:]``
    * ``qvel``
    * ``sensor("touch_toe", "touch_heel")`` as log(1 + x)
    """
    touch = jnp.log1p(seen.sensor("touch_toe", "touch_heel"))
    return joined(seen.state.qpos[1:], seen.state.qvel, touch)


def _standing_hopper(seen: Snapshot) -> jax.Array:
    height = (seen.xipos("torso") - seen.xipos("foot"))[2]
    return tolerance(height, (_HOPPER_HEIGHT, 2.0))


def _reward_hopper_stand(seen: Snapshot) -> jax.Array:
    """Return ``tolerance(h, [{_HOPPER_HEIGHT!g}, 2]) * (4 + small(u)) / 5``.

    h: metres from the foot's center of mass up to the torso's; u: the controls.
    """
    small = small_control(seen.state.ctrl)
    return _standing_hopper(seen) * (jnp.mean(small) + 4) / 5


def _reward_hopper_hop(seen: Snapshot) -> jax.Array:
    """Return how well it stands, times how fast it hops.

    ``tolerance(h, [{_HOPPER_HEIGHT!g}, 2]) * rising(v, {_HOPPER_SPEED!g},
    margin={_HOPPER_SPEED / 2!g}, value=0.5)``; h: metres from the foot's center of mass up to the
    torso's; v: velocity of the center of mass along x, m/s.
    """
    speed = seen.sensor("torso_subtreelinvel")[0]
    standing = _standing_hopper(seen)
    return standing * rising(speed, _HOPPER_SPEED, _HOPPER_SPEED / 2, value_at_margin=0.5)


def _observe_humanoid(seen: Snapshot) -> jax.Array:
    """Return the pose in the torso's frame, and velocities.

    * ``qpos[7:]``
    * ``1`` height of the head, m
    * ``12`` left hand, left foot, right hand, right foot from the torso, in the torso's frame, m
    * ``3`` z of the torso's axes x, y and z
    * ``sensor("torso_subtreelinvel")``
    * ``qvel``
    """
    torso, frame = seen.xpos("torso"), seen.xmat("torso")
    limbs = ("left_hand", "left_foot", "right_hand", "right_foot")
    extremities = [(seen.xpos(limb) - torso) @ frame for limb in limbs]
    return joined(
        seen.state.qpos[7:],
        seen.xpos("head")[2],
        *extremities,
        frame[2],
        seen.sensor("torso_subtreelinvel"),
        seen.state.qvel,
    )


def _reward_humanoid(seen: Snapshot, *, speed: float) -> jax.Array:
    """Return how well it stands, times how well it moves.

    Stands: ``tolerance(h, [{_HUMANOID_HEIGHT!g}, inf], margin={_HUMANOID_HEIGHT / 4!g}) * rising(z,
    0.9, margin=1.9) * (4 + small(u)) / 5``; h: height of the head, m; z: z of the torso's z axis;
    u: the controls. Moves: ``(5 * rising(v, speed, margin=speed) + 1) / 6``; v: horizontal speed of
    the center of mass, m/s. For speed 0, moves: the mean of ``tolerance(v, [0, 0], margin=2)`` over
    its velocities along x and y.
    """
    height = seen.xpos("head")[2]
    standing = tolerance(height, (_HUMANOID_HEIGHT, jnp.inf), margin=_HUMANOID_HEIGHT / 4)
    upright = rising(seen.xmat("torso")[2, 2], 0.9, margin=1.9)
    stand = (4 + jnp.mean(small_control(seen.state.ctrl))) / 5 * standing * upright
    velocity = seen.sensor("torso_subtreelinvel")[:2]
    if speed == 0:
        return stand * jnp.mean(tolerance(velocity, margin=2.0))
    move = rising(jnp.linalg.norm(velocity), speed, margin=speed)
    return stand * (5 * move + 1) / 6


def _start_quadruped(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample any rotation, at the lowest contact-free height in whole centimetres.

    Distances from the floor grow with the height, so they need to be computed only at height 0.
    """
    model = dynamics.model
    rotation = random_rotation(key)
    joints = jnp.asarray(model.qpos0[7:], jnp.float32)
    depth = -dynamics.clearances(joined(jnp.zeros(3), rotation, joints))[model.geom("floor").id]
    height = _QUADRUPED_LIFT * jnp.ceil(jnp.maximum(depth, 0.0) / _QUADRUPED_LIFT)
    return Start(joined(jnp.zeros(2), height, rotation, joints))


def _observe_quadruped(seen: Snapshot) -> jax.Array:
    """Return joints, activations, and the torso's velocity, rotation and sensors.

    * ``qpos[7:]``
    * ``qvel[6:]``
    * ``act``
    * ``sensor("velocimeter")``
    * ``1`` z of the torso's z axis: 1 is upright
    * ``sensors_of("GYRO", "ACCELEROMETER")``
    * ``sensors_of("FORCE", "TORQUE")`` as asinh(x)
    """
    model, kinds = seen.model, mujoco.mjtSensor
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    names = [model.joint(int(hinge)).name for hinge in hinges]
    return joined(
        seen.joint_pos(*names),
        seen.joint_vel(*names),
        seen.state.act,
        seen.sensor("velocimeter"),
        seen.xmat("torso")[2, 2],
        seen.sensors_of(kinds.mjSENS_GYRO, kinds.mjSENS_ACCELEROMETER),
        jnp.arcsinh(seen.sensors_of(kinds.mjSENS_FORCE, kinds.mjSENS_TORQUE)),
    )


def _reward_quadruped(seen: Snapshot, *, speed: float) -> jax.Array:
    """Return ``rising(z, 1, margin=2) * rising(v, speed, margin=speed, value=0.5)``.

    z: z of the torso's z axis; v: the torso's velocity along its own x axis, m/s.
    """
    upright = rising(seen.xmat("torso")[2, 2], 1.0, margin=2.0)
    return upright * rising(seen.sensor("velocimeter")[0], speed, speed, value_at_margin=0.5)


def _observe_walker(seen: Snapshot) -> jax.Array:
    """Return rotations, the torso's height, and velocities.

    * ``2 * (model.nbody - 1)`` of each body: x of its axes x and z
    * ``1`` height of the torso, m
    * ``qvel``
    """
    axes = quat_to_mat(seen.data.xquat[1:])[:, 0][:, jnp.array([0, 2])]
    return joined(axes, seen.xpos("torso")[2], seen.state.qvel)


def _reward_walker(seen: Snapshot, *, speed: float) -> jax.Array:
    """Return how well it stands, times how well it moves.

    Stands: ``(3 * tolerance(h, [{_WALKER_HEIGHT!g}, inf], margin={_WALKER_HEIGHT / 2!g}) +
    (1 + z) / 2) / 4``; h: height of the torso, m; z: z of its z axis. Moves: 1 for speed 0, else
    ``(5 * rising(v, speed, margin=speed / 2, value=0.5) + 1) / 6``; v: velocity of the center of
    mass along x, m/s.
    """
    height = seen.xpos("torso")[2]
    standing = tolerance(height, (_WALKER_HEIGHT, jnp.inf), margin=_WALKER_HEIGHT / 2)
    stand = (3 * standing + (1 + seen.xmat("torso")[2, 2]) / 2) / 4
    if speed == 0:
        return stand
    x_speed = seen.sensor("torso_subtreelinvel")[0]
    move = rising(x_speed, speed, speed / 2, value_at_margin=0.5)
    return stand * (5 * move + 1) / 6


_hopper = partial(
    Formulas,
    start_anywhere,
    _observe_hopper,
    substeps=4,
    reads_forces=True,
    starts_with_forces=True,
)


def _humanoid(speed: float) -> Formulas:
    reward = partial(_reward_humanoid, speed=speed)
    return Formulas(start_free_of_contact, _observe_humanoid, reward, substeps=5)


def _quadruped(speed: float) -> Formulas:
    return Formulas(
        _start_quadruped,
        _observe_quadruped,
        partial(_reward_quadruped, speed=speed),
        substeps=4,
        options={"floor_size": _QUADRUPED_EPISODE * speed},
        camera=2,
        reads_forces=True,
        starts_with_forces=True,
    )


def _walker(speed: float) -> Formulas:
    reward = partial(_reward_walker, speed=speed)
    return Formulas(start_anywhere, _observe_walker, reward, substeps=10)


TASKS = {
    "dmc_cheetah_run": Formulas(
        _start_cheetah, partial(observe_joints_from, skipped=1), _reward_cheetah
    ),
    "dmc_hopper_stand": _hopper(_reward_hopper_stand),
    "dmc_hopper_hop": _hopper(_reward_hopper_hop),
    "dmc_humanoid_stand": _humanoid(0.0),
    "dmc_humanoid_walk": _humanoid(1.0),
    "dmc_humanoid_run": _humanoid(10.0),
    "dmc_quadruped_walk": _quadruped(0.5),
    "dmc_quadruped_run": _quadruped(5.0),
    "dmc_walker_stand": _walker(0.0),
    "dmc_walker_walk": _walker(1.0),
    "dmc_walker_run": _walker(8.0),
}
