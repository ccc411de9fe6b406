"""Sampling of initial states."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Start
from pixelbrax_jax.physics.opengl import mujoco

MAX_ATTEMPTS = 1000
"""Largest number of sampled poses."""


def random_joints(model: mujoco.MjModel, key: jax.Array) -> jax.Array:
    """Sample joint positions (Q,) as DM Control's ``randomize_limited_and_rotational_joints`` does.

    Limited hinges and slides are uniform in their range, other hinges in [-pi, pi]. A free joint
    keeps its position; its quaternion is sampled uniformly from [0, 1]^4 and normalised, which is
    not uniform over rotations but is what DM Control does. There are no ball joints.
    """
    low, high = np.array(model.qpos0), np.array(model.qpos0)
    rotations = []
    for kind, limited, reach, at in zip(
        model.jnt_type, model.jnt_limited, model.jnt_range, model.jnt_qposadr, strict=True
    ):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            low[at + 3 : at + 7], high[at + 3 : at + 7] = 0.0, 1.0
            rotations.append(int(at) + 3)
        elif limited:
            low[at], high[at] = reach
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            low[at], high[at] = -np.pi, np.pi
    qpos = low + (high - low) * jax.random.uniform(key, (model.nq,))
    qpos = qpos.astype(jnp.float32)
    for at in rotations:
        quat = qpos[at : at + 4]
        qpos = qpos.at[at : at + 4].set(quat / jnp.linalg.norm(quat))
    return qpos


def random_rotation(key: jax.Array) -> jax.Array:
    """Sample a (4,) float32 unit quaternion, uniformly over rotations."""
    quat = jax.random.normal(key, (4,))
    return quat / jnp.linalg.norm(quat)


def free_of_contact(
    dynamics: Dynamics, key: jax.Array, sample: Callable[[jax.Array, Start], Start]
) -> Start:
    """Sample initial states until no geoms touch, at most ``MAX_ATTEMPTS`` times.

    ``sample`` maps a key and the previous sample, at first all zeros, to an initial state. The last
    one is returned even if geoms touch.
    """

    def again(carry: tuple[jax.Array, Start, jax.Array]) -> jax.Array:
        attempt, _, touches = carry
        return touches & (attempt < MAX_ATTEMPTS)

    def attempt(
        carry: tuple[jax.Array, Start, jax.Array],
    ) -> tuple[jax.Array, Start, jax.Array]:
        number, before, _ = carry
        start = sample(jax.random.fold_in(key, number), before)
        return number + 1, start, dynamics.touches(start.qpos)

    zeros = Start(jnp.zeros(dynamics.model.nq), jnp.zeros(dynamics.model.nv))
    shapes = jax.eval_shape(sample, key, zeros)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.while_loop(again, attempt, (jnp.int32(0), nothing, jnp.bool_(True)))[1]
