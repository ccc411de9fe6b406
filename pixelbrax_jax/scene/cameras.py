"""Camera rigs: the viewpoints of each task, and views that every task has."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.tasks import TASKS, Vector, View
from pixelbrax_jax.types import Camera, CameraRig, GeomKind, Geoms
from pixelbrax_jax.validation import check_choice

_DISTANT = 1000
"""Radii of a sphere or capsule: farther away, float32 moves its edge by some hundredths of one."""


def _f32(values: Any) -> Any:
    # NumPy, not JAX: importing this package must not start a device.
    return np.asarray(values, np.float32)


def rig(
    eye: Vector,
    target: Vector,
    fovy: float,
    *,
    link: int = -1,
    track: Vector = (1.0, 1.0, 0.0),
    up: Vector = (0.0, 0.0, 1.0),
) -> CameraRig:
    """Make a camera rig from plain numbers.

    Args:
        eye: metres; relative to the tracked link along tracked axes, absolute along others.
        target: metres, likewise; the point looked at.
        fovy: vertical field of view, degrees, between 0 and 180.
        link: index of the followed link, -1 for a camera at rest.
        track: how much of the link's position is followed, per world axis.
        up: the world direction that is up in the image.

    Returns:
        The rig, float32.

    Raises:
        ValueError: eye and target coincide, ``up`` is along the view, or ``fovy`` is outside
            (0, 180).
    """
    if not 0.0 < fovy < 180.0:
        raise ValueError(f"fovy must lie between 0 and 180 degrees, got {fovy}.")
    view = np.subtract(target, eye)
    if np.linalg.norm(np.cross(view, up)) < 1e-6 * max(float(np.linalg.norm(view)), 1e-6):
        raise ValueError(
            f"a camera at {eye} cannot look at {target} with up={up}: the two points must "
            "differ and 'up' must not be parallel to the view."
        )
    return CameraRig(
        link=link,
        track=_f32(track if link >= 0 else (0.0, 0.0, 0.0)),
        eye=_f32(eye),
        target=_f32(target),
        up=_f32(up),
        fovy=_f32(fovy),
    )


def _rig_of(view: View) -> CameraRig:
    return rig(view.eye, view.target, view.fovy, link=view.link, up=view.up)


DEFAULT = {name: _rig_of(row.camera) for name, row in TASKS.items() if row.camera}
ORIGINAL = {
    name: _rig_of(row.original_camera) for name, row in TASKS.items() if row.original_camera
}


def _around(base: CameraRig, direction: Vector, up: Vector) -> CameraRig:
    """Return ``base`` seen from another side, at the same distance from the same target."""
    away = np.array(direction) / np.linalg.norm(direction)
    distance = np.linalg.norm(base.eye - base.target)
    eye = base.target + np.float32(distance) * away.astype(np.float32)
    return dataclasses.replace(base, eye=eye, up=_f32(up))


def rigs_of(
    task: str, fallback: CameraRig | Mapping[str, CameraRig] | None = None
) -> dict[str, CameraRig]:
    """Return all rigs of a task by name.

    Args:
        task: Brax's name of the task, or any name with ``fallback`` given.
        fallback: default rig of a task that has no row of its own; or several rigs by name, one
            of them ``default``.

    Returns:
        ``default``, ``side`` (seen along +y), ``front`` (along -x), ``top`` (from above, +y up
        in the image), those of ``fallback``, and ``original`` where the paper has one.
    """
    given: Mapping[str, CameraRig] = {}
    if isinstance(fallback, Mapping):
        given = fallback
    elif fallback is not None:
        given = {"default": fallback}
    default = DEFAULT.get(task, given.get("default"))
    if default is None:
        raise ValueError(f"no camera rig is known for task {task!r}: give one as `camera=`.")
    rigs = {
        "default": default,
        "side": _around(default, (0.0, -1.0, 0.15), (0.0, 0.0, 1.0)),
        "front": _around(default, (1.0, 0.0, 0.15), (0.0, 0.0, 1.0)),
        "top": _around(default, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
        **given,
    } | {"default": default}
    if task in ORIGINAL:
        rigs["original"] = ORIGINAL[task]
    return rigs


def make_rig(
    task: str,
    camera: str | CameraRig | Camera = "default",
    fallback: CameraRig | Mapping[str, CameraRig] | None = None,
) -> CameraRig:
    """Return a rig by name, the given one, or one that holds a camera at rest.

    Args:
        task: the task's name.
        camera: a name of ``rigs_of``, a ``CameraRig`` or a ``Camera``.
        fallback: default rig of a task that has no row of its own, or several by name.

    Returns:
        The rig.

    Raises:
        ValueError: the name is unknown.
        TypeError: ``camera`` is of another type.
    """
    if isinstance(camera, CameraRig):
        return camera
    if isinstance(camera, Camera):
        return at_rest(camera)
    if not isinstance(camera, str):
        raise TypeError(
            "camera must be a name, a pixelbrax_jax.CameraRig or a pixelbrax_jax.Camera, "
            f"got {camera!r}; names: {', '.join(sorted(rigs_of(task, fallback)))}."
        )
    rigs = rigs_of(task, fallback)
    return rigs[check_choice(f"camera of task {task!r}", camera, rigs)]


def at_rest(camera: Camera) -> CameraRig:
    """Return the rig that always yields ``camera``."""
    pos = _f32(camera.pos)
    xmat = _f32(camera.xmat)
    return CameraRig(
        link=-1,
        track=_f32([0.0] * 3),
        eye=pos,
        target=pos - xmat[:, 2],
        up=xmat[:, 1],
        fovy=_f32(camera.fovy),
    )


def aim(rig: CameraRig, xpos: jax.Array) -> Camera:
    """Return the camera of a rig for the current link positions.

    Args:
        rig: the rig.
        xpos: (L, 3) float32, metres, link origins in the world frame.

    Returns:
        The camera in the world frame.
    """
    follow = rig.track * xpos[rig.link] if rig.link >= 0 else jnp.zeros(3)
    eye, target = rig.eye + follow, rig.target + follow
    return Camera(pos=eye, xmat=spatial.look_at(eye, target, rig.up), fovy=jnp.asarray(rig.fovy))


def seen_from(geoms: Geoms, rig: CameraRig) -> Geoms:
    """Return the geoms as a camera needs them, which may be very far away: see ``Geoms.distant``.

    Args:
        geoms: the shapes.
        rig: the camera; its distance is taken from the link that it follows, or from the origin.
    """
    round_ones = [kind in (GeomKind.SPHERE, GeomKind.CAPSULE) for kind in geoms.kind]
    radii = np.asarray(geoms.size)[round_ones, 0]
    away = np.linalg.norm(np.asarray(rig.eye))
    return geoms.replace(distant=bool(len(radii) and away > _DISTANT * radii.min()))


def rig_around(points: np.ndarray, link: int = 0) -> CameraRig:
    """Make a rig that has all points in view, for a task without a viewpoint of its own.

    Args:
        points: (P, 3) metres, world frame, at least one.
        link: index of the link to follow horizontally.

    Returns:
        A rig that looks from a corner, slightly from above, and follows the link's x and y.
    """
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = max(float(np.linalg.norm(points - center, axis=1).max()), 0.1)
    eye = center + radius * np.array([2.0, -2.0, 1.2])
    to_vector = lambda v: (float(v[0]), float(v[1]), float(v[2]))  # noqa: E731
    return rig(to_vector(eye), to_vector(center), 50.0, link=link)
