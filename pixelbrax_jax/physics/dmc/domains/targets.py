"""Bodies that move to a target: fish, point mass, reacher and swimmer."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.dmc.formulas import (
    random_joints,
    random_rotation,
    small_control,
    start_anywhere,
    tolerance,
)
from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import Formulas, Snapshot, Start, joined, observe_joints
from pixelbrax_jax.physics.mujoco.opengl import mujoco

_FISH_JOINTS = (
    "tail1",
    "tail_twist",
    "tail2",
    "finright_roll",
    "finright_pitch",
    "finleft_roll",
    "finleft_pitch",
)

_SWIMMER_BODY_SENSORS = 12
"""Index of the bodies' velocities, after readings of nose, target and head's axes."""


def _start_fish_upright(dynamics: Dynamics, key: jax.Array) -> Start:
    rotation, joints = jax.random.split(key)
    model = dynamics.model
    bend = jax.random.uniform(joints, (model.nq - 7,), minval=-0.2, maxval=0.2)
    place = jnp.asarray(model.qpos0[:3], jnp.float32)
    return Start(joined(place, random_rotation(rotation), bend))


def _start_fish_swim(dynamics: Dynamics, key: jax.Array) -> Start:
    fish, target = jax.random.split(key)
    low, high = jnp.array([-0.4, -0.4, 0.1]), jnp.array([0.4, 0.4, 0.3])
    place = jax.random.uniform(target, (3,), minval=low, maxval=high)
    return _start_fish_upright(dynamics, fish).replace(target=place)


def _fish_upright(seen: Snapshot) -> jax.Array:
    return seen.xmat("torso")[2, 2]


def _fish_to_target(seen: Snapshot) -> jax.Array:
    """Return (3,) metres, the vector from the mouth to the target in the mouth's frame."""
    return (seen.state.target - seen.geom_pos("mouth")) @ seen.geom_mat("mouth")


def _observe_fish_upright(seen: Snapshot) -> jax.Array:
    """Return joint positions, how upright it is, and velocities.

    * ``joint_pos(*_FISH_JOINTS)``
    * ``1`` z of the torso's z axis: 1 is upright
    * ``qvel``
    """
    return joined(seen.joint_pos(*_FISH_JOINTS), _fish_upright(seen), seen.state.qvel)


def _observe_fish_swim(seen: Snapshot) -> jax.Array:
    """Return the same with the vector to the target.

    * ``joint_pos(*_FISH_JOINTS)``
    * ``1`` z of the torso's z axis: 1 is upright
    * ``3`` from the mouth to the target in the mouth's frame, m
    * ``qvel``
    """
    joints = seen.joint_pos(*_FISH_JOINTS)
    return joined(joints, _fish_upright(seen), _fish_to_target(seen), seen.state.qvel)


def _reward_fish_upright(seen: Snapshot) -> jax.Array:
    """Return ``tolerance(z, [1, 1], margin=1)``; z: z of the torso's z axis."""
    return tolerance(_fish_upright(seen), (1.0, 1.0), margin=1.0)


def _reward_fish_swim(seen: Snapshot) -> jax.Array:
    """Return ``(7 * tolerance(d, [0, r], margin=2 * r) + (1 + z) / 2) / 8``.

    d: metres from the mouth to the target; r: their radii together,
    {model.geom("mouth").size[0] + model.geom("target").size[0]!g} m; z: z of the torso's z axis.
    """
    reach = sum(float(seen.model.geom(name).size[0]) for name in ("mouth", "target"))
    near = tolerance(jnp.linalg.norm(_fish_to_target(seen)), (0.0, reach), margin=2 * reach)
    return (7 * near + 0.5 * (_fish_upright(seen) + 1)) / 8


def _hide_target(model: mujoco.MjModel) -> None:
    model.geom("target").rgba[3] = 0.0


def _reward_point_mass(seen: Snapshot) -> jax.Array:
    """Return ``tolerance(d, [0, r], margin=r) * (4 + small(u)) / 5``.

    d: metres from the point to the target; r: the target's radius,
    {model.geom("target").size[0]!g} m; u: the controls.
    """
    distance = jnp.linalg.norm(seen.geom_pos("target") - seen.geom_pos("pointmass"))
    radius = float(seen.model.geom("target").size[0])
    near = tolerance(distance, (0.0, radius), margin=radius)
    return near * (jnp.mean(small_control(seen.state.ctrl)) + 4) / 5


def _start_reacher(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions, and a target 5 to 20 cm away from the shoulder."""
    joints, angle, radius = jax.random.split(key, 3)
    model = dynamics.model
    angle = jax.random.uniform(angle, (), minval=0.0, maxval=2 * jnp.pi)
    radius = jax.random.uniform(radius, (), minval=0.05, maxval=0.20)
    height = float(model.geom("target").pos[2])
    target = jnp.stack([radius * jnp.sin(angle), radius * jnp.cos(angle), height])
    return Start(random_joints(model, joints), target=target)


def _reacher_to_target(seen: Snapshot) -> jax.Array:
    """Return (2,) metres, the vector from the finger to the target in the plane."""
    return (seen.state.target - seen.geom_pos("finger"))[:2]


def _observe_reacher(seen: Snapshot) -> jax.Array:
    """Return joint positions, the vector to the target, and velocities.

    * ``qpos``
    * ``2`` from the finger to the target: x and y, m
    * ``qvel``
    """
    return joined(seen.state.qpos, _reacher_to_target(seen), seen.state.qvel)


def _reward_reacher(seen: Snapshot) -> jax.Array:
    """Return 1 while the finger touches the target, else 0.

    Touches: their centers are at most the sum of their radii apart,
    {model.geom("target").size[0] + model.geom("finger").size[0]!g} m.
    """
    reach = sum(float(seen.model.geom(name).size[0]) for name in ("target", "finger"))
    return tolerance(jnp.linalg.norm(_reacher_to_target(seen)), (0.0, reach))


def _resize_target(model: mujoco.MjModel, *, radius: float) -> None:
    model.geom("target").size[0] = radius


def _start_swimmer(dynamics: Dynamics, key: jax.Array) -> Start:
    joints, near, place = jax.random.split(key, 3)
    model = dynamics.model
    reach = jnp.where(jax.random.uniform(near) < 0.2, 0.3, 2.0)
    xy = jax.random.uniform(place, (2,), minval=-1.0, maxval=1.0) * reach
    target = joined(xy, float(model.geom("target").pos[2]))
    return Start(random_joints(model, joints), target=target)


def _swimmer_to_target(seen: Snapshot) -> jax.Array:
    """Return (2,) metres, the vector from the nose to the target in the head's frame."""
    return ((seen.state.target - seen.geom_pos("nose")) @ seen.xmat("head"))[:2]


def _observe_swimmer(seen: Snapshot) -> jax.Array:
    """Return joint positions, the vector to the target, and velocities of the bodies.

    * ``qpos[3:]``
    * ``2`` from the nose to the target in the head's frame: x and y, m
    * ``3 * (model.nbody - 1)`` of each body: x and y of its velocity (m/s), z of its turn (rad/s)
    """
    readings = seen.data.sensordata[_SWIMMER_BODY_SENSORS:].reshape(-1, 6)
    return joined(seen.state.qpos[3:], _swimmer_to_target(seen), readings[:, jnp.array([0, 1, 5])])


def _reward_swimmer(seen: Snapshot) -> jax.Array:
    """Return 1 while the nose is inside the target, and less with the distance from its edge.

    Outside: ``1 / (1 + (3 * d / {5 * model.geom("target").size[0]!g}) ** 2)``; d: metres from the
    nose to the target's edge, {model.geom("target").size[0]!g} m from its center.
    """
    radius = float(seen.model.geom("target").size[0])
    distance = jnp.linalg.norm(_swimmer_to_target(seen))
    return tolerance(distance, (0.0, radius), margin=5 * radius, sigmoid="long_tail")


def _reacher(radius: float) -> Formulas:
    edit = partial(_resize_target, radius=radius)
    return Formulas(
        _start_reacher,
        _observe_reacher,
        _reward_reacher,
        edit=edit,
        movable=("target",),
        prefers_xla=True,
    )


def _swimmer(num_bodies: int) -> Formulas:
    return Formulas(
        _start_swimmer,
        _observe_swimmer,
        _reward_swimmer,
        substeps=15,
        options={"num_bodies": num_bodies},
        movable=("target", "target_light"),
    )


TASKS = {
    "dmc_fish_upright": Formulas(
        _start_fish_upright,
        _observe_fish_upright,
        _reward_fish_upright,
        substeps=10,
        edit=_hide_target,
    ),
    "dmc_fish_swim": Formulas(
        _start_fish_swim,
        _observe_fish_swim,
        _reward_fish_swim,
        substeps=10,
        movable=("target",),
    ),
    "dmc_point_mass_easy": Formulas(
        start_anywhere, observe_joints, _reward_point_mass, prefers_xla=True
    ),
    "dmc_reacher_easy": _reacher(0.05),
    "dmc_reacher_hard": _reacher(0.015),
    "dmc_swimmer_swimmer6": _swimmer(6),
    "dmc_swimmer_swimmer15": _swimmer(15),
}
