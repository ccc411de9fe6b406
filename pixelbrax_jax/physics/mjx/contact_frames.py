"""Friction of steep capsules on planes, as MuJoCo has it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.brax.compatibility import import_silenced

with import_silenced():
    from mujoco.mjx._src import collision_driver
    from mujoco.mjx._src.types import GeomType

_PAIR = (GeomType.PLANE, GeomType.CAPSULE)


@contextmanager
def aligned_with_capsules() -> Iterator[None]:
    """Align contacts of capsules with planes as MuJoCo does, in what is traced in the block.

    The cone of friction is a pyramid, and so it matters which way its edges point. MuJoCo points
    the first along the capsule, however steep that is; MuJoCo XLA along an axis of the world where
    the capsule is steeper than 60 degrees, which changes single control steps of the humanoid by
    up to 0.3 rad/s. Other users of MuJoCo XLA in the process are not affected.
    """
    functions = collision_driver._COLLISION_FUNC
    theirs = functions[_PAIR]

    def aligned(model: Any, data: Any, key: Any, geom: jax.Array) -> tuple[jax.Array, ...]:
        dist, pos, frame = theirs(model, data, key, geom)
        normal = data.geom_xmat[geom[:, 0]][:, :, 2]
        axis = data.geom_xmat[geom[:, 1]][:, :, 2]
        along = axis - normal * jnp.sum(normal * axis, axis=-1, keepdims=True)
        length = jnp.linalg.norm(along, axis=-1, keepdims=True)
        along = along / jnp.maximum(length, 1e-6)
        ours = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
        # A capsule that stands upright has no direction. Both of its ends have the same frame.
        ours = jnp.where(length[:, :, None] > 1e-6, ours, frame[::2])
        return dist, pos, jnp.repeat(ours, 2, axis=0)

    aligned.ncon = theirs.ncon  # type: ignore[attr-defined]
    functions[_PAIR] = aligned
    try:
        yield
    finally:
        functions[_PAIR] = theirs
