"""Joint positions and velocities of a MuJoCo model."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.spatial import quat_normalize


def check_pose(
    model: mujoco.MjModel, q: jax.Array, qd: jax.Array | None
) -> tuple[jax.Array, jax.Array]:
    """Return (Q,) and (V,) float32, velocities 0 by default; raise ValueError for a wrong shape."""
    q = jnp.asarray(q, jnp.float32)
    qd = jnp.asarray(jnp.zeros(model.nv) if qd is None else qd, jnp.float32)
    if q.shape != (model.nq,) or qd.shape != (model.nv,):
        raise ValueError(
            f"qpos and qvel must have shapes ({model.nq},) and ({model.nv},), got {q.shape} and "
            f"{qd.shape}"
        )
    return q, qd


def with_unit_rotations(model: mujoco.MjModel, q: jax.Array) -> jax.Array:
    """Return joint positions (Q,) with normalized quaternions of free and ball joints."""
    for kind, address in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            rotation = slice(address + 3, address + 7)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            rotation = slice(address, address + 4)
        else:
            continue
        q = q.at[rotation].set(quat_normalize(q[rotation]))
    return q


def masses_below(model: mujoco.MjModel, root: int) -> np.ndarray:
    """Return (bodies - 1,) float32, each body's fraction of the mass of ``root``'s subtree."""
    below = np.zeros(model.nbody, bool)
    below[root] = True
    for body in range(1, model.nbody):
        below[body] |= below[model.body_parentid[body]]
    masses = np.where(below, model.body_mass, 0.0)[1:]
    return (masses / masses.sum()).astype(np.float32)
