"""Joint positions and velocities of a MuJoCo model."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.viewpoints import tracked_body
from pixelbrax_jax.spatial import f32, quat_normalize, rotate


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


def center_of_mass(model: mujoco.MjModel, xpos: jax.Array, xquat: jax.Array) -> jax.Array:
    """Return (3,), the center of mass of the subtree of the tracked body, else of the model.

    ``xpos`` (B, 3) and ``xquat`` (B, 4) are the poses of all bodies but the world. The center of a
    subtree without mass is that of its root, as in MuJoCo.
    """
    root = max(tracked_body(model), 0)
    below = np.arange(model.nbody) == root
    for body in range(1, model.nbody):
        below[body] |= below[model.body_parentid[body]]
    masses = np.where(below, model.body_mass, 0.0)
    if masses.sum() < mujoco.mjMINVAL:
        masses = np.arange(model.nbody) == root
    shares = f32(masses[1:] / masses.sum())
    return jnp.dot(shares, xpos + rotate(xquat, f32(model.body_ipos[1:])))


def with_center_of_mass(
    model: mujoco.MjModel, xpos: jax.Array, xquat: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return poses (B, 3) and (B, 4) with a row for the center of mass, which never turns."""
    com, upright = center_of_mass(model, xpos, xquat), jnp.array([[1.0, 0.0, 0.0, 0.0]])
    return jnp.concatenate([xpos, com[None]]), jnp.concatenate([xquat, upright])


def body_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return names of all bodies but the world, ``link/<index>`` for one without."""
    return tuple(model.body(i).name or f"link/{i - 1}" for i in range(1, model.nbody))
