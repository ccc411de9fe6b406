"""Friction of steep capsules on planes, in MuJoCo's contact frames."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mujoco_compatibility import import_silenced

with import_silenced():
    from mujoco.mjx._src import collision_driver
    from mujoco.mjx._src.types import GeomType

PAIR = (GeomType.PLANE, GeomType.CAPSULE)
"""Key of MuJoCo XLA's collision function for these shapes."""

_theirs = collision_driver._COLLISION_FUNC[PAIR]


def aligned_with_capsules(
    model: Any, data: Any, key: Any, geom: jax.Array
) -> tuple[jax.Array, ...]:
    """Collide planes with capsules as MuJoCo XLA does, but with MuJoCo's contact frames.

    The friction cone is a pyramid, so the direction of its edges matters. MuJoCo points the first
    edge along the capsule. MuJoCo XLA points it along a world axis if the capsule is steeper than
    60 degrees, which changes single control steps of the humanoid by up to 0.3 rad/s.
    """
    dist, pos, frame = _theirs(model, data, key, geom)
    normal = data.geom_xmat[geom[:, 0]][:, :, 2]
    axis = data.geom_xmat[geom[:, 1]][:, :, 2]
    along = axis - normal * jnp.sum(normal * axis, axis=-1, keepdims=True)
    length = jnp.linalg.norm(along, axis=-1, keepdims=True)
    along = along / jnp.maximum(length, 1e-6)
    ours = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    # An upright capsule has no direction. Both of its ends have the same frame.
    ours = jnp.where(length[:, :, None] > 1e-6, ours, frame[::2])
    return dist, pos, jnp.repeat(ours, 2, axis=0)


aligned_with_capsules.ncon = _theirs.ncon  # type: ignore[attr-defined]
