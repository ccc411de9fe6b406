"""A fish that swims to a target in three dimensions."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance
from pixelbrax_jax.physics.mjx.resets import random_rotation
from pixelbrax_jax.physics.opengl import mujoco

_JOINTS = (
    "tail1",
    "tail_twist",
    "tail2",
    "finright_roll",
    "finright_pitch",
    "finleft_roll",
    "finleft_pitch",
)


def _start_upright(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample any rotation, and joint positions within 0.2 rad."""
    rotation, joints = jax.random.split(key)
    model = dynamics.model
    bend = jax.random.uniform(joints, (model.nq - 7,), minval=-0.2, maxval=0.2)
    place = jnp.asarray(model.qpos0[:3], jnp.float32)
    return Start(joined(place, random_rotation(rotation), bend))


def _start_swim(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample the fish as for uprighting, and a target in a box."""
    fish, target = jax.random.split(key)
    low, high = jnp.array([-0.4, -0.4, 0.1]), jnp.array([0.4, 0.4, 0.3])
    place = jax.random.uniform(target, (3,), minval=low, maxval=high)
    return _start_upright(dynamics, fish).replace(target=place)


def _upright(seen: Snapshot) -> jax.Array:
    return seen.xmat("torso")[2, 2]


def _to_target(seen: Snapshot) -> jax.Array:
    """Return (3,) metres, the vector from the mouth to the target in the mouth's frame."""
    return (seen.target - seen.geom_pos("mouth")) @ seen.geom_mat("mouth")


def _observe_upright(seen: Snapshot) -> jax.Array:
    return joined(seen.joint_pos(*_JOINTS), _upright(seen), seen.qvel)


def _observe_swim(seen: Snapshot) -> jax.Array:
    return joined(seen.joint_pos(*_JOINTS), _upright(seen), _to_target(seen), seen.qvel)


def _reward_upright(seen: Snapshot) -> jax.Array:
    return tolerance(_upright(seen), (1.0, 1.0), margin=1.0)


def _reward_swim(seen: Snapshot) -> jax.Array:
    """Return how near the mouth is to the target, and a little for being upright."""
    reach = sum(float(seen.model.geom(name).size[0]) for name in ("mouth", "target"))
    near = tolerance(jnp.linalg.norm(_to_target(seen)), (0.0, reach), margin=2 * reach)
    return (7 * near + 0.5 * (_upright(seen) + 1)) / 8


def _hide_target(model: mujoco.MjModel) -> None:
    model.geom("target").rgba[3] = 0.0


TASKS = {
    "upright": Formulas(
        _start_upright, _observe_upright, _reward_upright, substeps=10, edit=_hide_target
    ),
    "swim": Formulas(_start_swim, _observe_swim, _reward_swim, substeps=10, movable=("target",)),
}
