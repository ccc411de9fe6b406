"""A planar chain of bodies that swims to a target."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance
from pixelbrax_jax.physics.mjx.resets import random_joints

_FIRST_BODY_SENSOR = 12
"""Index of the bodies' velocities, after readings of nose, target and head's axes."""


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions and heading, and a target that is near in one of five episodes."""
    joints, near, place = jax.random.split(key, 3)
    model = dynamics.model
    reach = jnp.where(jax.random.uniform(near) < 0.2, 0.3, 2.0)
    xy = jax.random.uniform(place, (2,), minval=-1.0, maxval=1.0) * reach
    target = joined(xy, float(model.geom("target").pos[2]))
    return Start(random_joints(model, joints), target=target)


def _to_target(seen: Snapshot) -> jax.Array:
    """Return (2,) metres, the vector from the nose to the target in the head's frame."""
    return ((seen.target - seen.geom_pos("nose")) @ seen.xmat("head"))[:2]


def _observe(seen: Snapshot) -> jax.Array:
    """Return joint positions, vector to the target, and each body's velocities in its frame."""
    names = [seen.model.sensor(i).name for i in range(seen.model.nsensor)]
    readings = seen.sensor(*names)[_FIRST_BODY_SENSOR:].reshape(-1, 6)
    return joined(seen.qpos[3:], _to_target(seen), readings[:, jnp.array([0, 1, 5])])


def _reward(seen: Snapshot) -> jax.Array:
    radius = float(seen.model.geom("target").size[0])
    distance = jnp.linalg.norm(_to_target(seen))
    return tolerance(distance, (0.0, radius), margin=5 * radius, sigmoid="long_tail")


def _task(num_bodies: int) -> Formulas:
    return Formulas(
        _start,
        _observe,
        _reward,
        substeps=15,
        options={"num_bodies": num_bodies},
        movable=("target", "target_light"),
    )


TASKS = {"swimmer6": _task(6), "swimmer15": _task(15)}
