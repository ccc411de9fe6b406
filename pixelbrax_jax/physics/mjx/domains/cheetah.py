"""A planar two-legged body that runs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, rising
from pixelbrax_jax.physics.mjx.resets import random_joints
from pixelbrax_jax.physics.opengl import mujoco

_RUN_SPEED = 10.0
_SETTLING_STEPS = 200


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample limited joints uniformly, then let the body fall for 200 physics steps.

    DM Control samples joints after it has computed the forces of the model's default pose. The
    first step uses these forces, and so has the same velocity in every episode.
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
    state, _ = dynamics.step(state, _SETTLING_STEPS - 1)
    return Start(state.qpos, state.qvel)


def _observe(seen: Snapshot) -> jax.Array:
    """Return joint positions without x, and velocities."""
    return joined(seen.qpos[1:], seen.qvel)


def _reward(seen: Snapshot) -> jax.Array:
    return rising(seen.sensor("torso_subtreelinvel")[0], _RUN_SPEED, margin=_RUN_SPEED)


TASKS = {"run": Formulas(_start, _observe, _reward)}
