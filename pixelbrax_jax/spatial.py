"""Rotations, frames and camera rigs in float32; quaternions are MuJoCo's, ``(w, x, y, z)``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.types import CameraRig
from pixelbrax_jax.validation import check_arrays, check_link


def f32(values: Any) -> Any:
    """Return a float32 NumPy array, because importing the package must not start a device."""
    return np.asarray(values, np.float32)


def quat_multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the product (..., 4): the rotation that applies ``b`` first, then ``a``."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_normalize(quat: jax.Array) -> jax.Array:
    """Return the unit quaternion (..., 4) of the same rotation; the identity for zero."""
    square = jnp.sum(quat * quat, axis=-1, keepdims=True)
    identity = jnp.array([1.0, 0.0, 0.0, 0.0], quat.dtype)
    # The inner `where` keeps the gradient finite at the zero quaternion.
    unit = quat * jax.lax.rsqrt(jnp.where(square > 0, square, 1.0))
    return jnp.where(square > 0, unit, identity)


def axis_angle(axis: jax.Array, angle: jax.Array) -> jax.Array:
    """Return the unit quaternion (4,) of a turn about ``axis`` (3,), of length 1, by radians."""
    return jnp.concatenate([jnp.cos(0.5 * angle)[None], jnp.sin(0.5 * angle) * axis])


def quat_to_mat(quat: jax.Array) -> jax.Array:
    """Return the matrix (..., 3, 3) of a unit quaternion; its columns are the rotated axes."""
    w, x, y, z = (quat[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotate(quat: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotate ``vector`` (..., 3) by the unit quaternion ``quat`` (..., 4)."""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2 * jnp.cross(axis, vector)
    return vector + w * twice + jnp.cross(axis, twice)


def unit(vector: jax.Array) -> jax.Array:
    """Scale ``vector`` (..., 3) to length 1; zero stays zero, with a zero gradient."""
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    return jnp.where(square > 0, vector * jax.lax.rsqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def look_at(eye: jax.Array, target: jax.Array, up: jax.Array) -> jax.Array:
    """Return the (3, 3) orientation of a camera: right, up, back; the view is not along ``up``."""
    back = unit(eye - target)
    right = unit(jnp.cross(up, back))
    return jnp.stack([right, jnp.cross(back, right), back], axis=-1)


def make_rig(
    eye: Sequence[float] | np.ndarray,
    target: Sequence[float] | np.ndarray,
    fovy: float,
    *,
    link: int = -1,
    track: Sequence[float] = (1.0, 1.0, 0.0),
    up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
) -> CameraRig:
    """Make a camera rig from plain numbers.

    Args:
        eye: metres; relative to the followed link along tracked axes, absolute along others.
        target: metres, likewise; the point the camera looks at.
        fovy: vertical field of view, degrees, between 0 and 180.
        link: index of the followed link, -1 for none.
        track: fraction of the link's position to follow, per world axis.
        up: the world direction that is up in the image.

    Raises:
        ValueError: a number is not finite or missing, eye and target coincide, ``up`` is parallel
            to the view, or ``fovy`` is wrong.
    """
    if check_link("link", link) < 0:
        track = (0.0, 0.0, 0.0)
    parts: dict[str, Any] = {"eye": eye, "target": target, "up": up, "fovy": fovy, "track": track}
    return check_rig(CameraRig(link=link, **parts))


def check_rig(rig: CameraRig) -> CameraRig:
    """Return the rig with float32 arrays; raise a ValueError if nothing can be seen with it."""
    shapes = {"track": (3,), "eye": (3,), "target": (3,), "up": (3,), "fovy": ()}
    parts = check_arrays("a CameraRig", rig, shapes)
    if not 0.0 < parts["fovy"] < 180.0:
        raise ValueError(f"fovy must lie between 0 and 180 degrees, got {rig.fovy}.")
    check_link("link of a CameraRig", rig.link)
    eye, target, up = (parts[name] for name in ("eye", "target", "up"))
    view = target - eye
    if np.linalg.norm(np.cross(view, up)) < 1e-6 * max(float(np.linalg.norm(view)), 1e-6):
        raise ValueError(
            f"a camera at {eye} cannot look at {target} with up={up}: the two points must "
            "differ and 'up' must not be parallel to the view."
        )
    return rig.replace(**parts)
