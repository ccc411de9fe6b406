"""Camera rigs, and the cameras they give."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.types import Camera, CameraRig, GeomKind, Geoms
from pixelbrax_jax.validation import check_choice

_DISTANT = 1000
"""Radii of a sphere or capsule beyond which float32 moves its edge by some hundredths of a
radius."""


class _Side(NamedTuple):
    """A view of the default's target from the default's distance: direction to the eye, and up."""

    direction: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


SIDES: Mapping[str, _Side] = {
    "side": _Side((0.0, -1.0, 0.15)),
    "front": _Side((1.0, 0.0, 0.15)),
    "top": _Side((0.0, 0.0, 1.0), up=(0.0, 1.0, 0.0)),
}
"""Views that every task has besides ``default``."""


def _f32(values: Any) -> Any:
    # NumPy, not JAX: importing this package must not start a device.
    return np.asarray(values, np.float32)


def make_rig(
    eye: Sequence[float],
    target: Sequence[float],
    fovy: float,
    *,
    link: int = -1,
    track: Sequence[float] = (1.0, 1.0, 0.0),
    up: Sequence[float] = (0.0, 0.0, 1.0),
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
        ValueError: eye and target coincide, ``up`` is parallel to the view, or ``fovy`` is outside
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


def with_sides(rigs: Mapping[str, CameraRig]) -> dict[str, CameraRig]:
    """Return a task's ``default``, ``SIDES`` and its other rigs, which override ``SIDES``."""
    default = rigs["default"]
    sides = {name: _seen_from_side(default, side) for name, side in SIDES.items()}
    return {"default": default, **sides, **rigs}


def _seen_from_side(base: CameraRig, side: _Side) -> CameraRig:
    away = np.array(side.direction) / np.linalg.norm(side.direction)
    distance = np.linalg.norm(base.eye - base.target)
    eye = base.target + np.float32(distance) * away.astype(np.float32)
    return dataclasses.replace(base, eye=eye, up=_f32(side.up))


def choose_rig(
    task: str, camera: str | CameraRig | Camera, rigs: Mapping[str, CameraRig]
) -> CameraRig:
    """Return a rig by name, the given rig, or a rig for a fixed camera.

    Raises:
        ValueError: the task has no rig of that name.
        TypeError: ``camera`` has another type.
    """
    if isinstance(camera, CameraRig):
        return camera
    if isinstance(camera, Camera):
        return rig_at_rest(camera)
    if not isinstance(camera, str):
        raise TypeError(
            "camera must be a name, a pixelbrax_jax.CameraRig or a pixelbrax_jax.Camera, "
            f"got {camera!r}; names: {', '.join(sorted(rigs))}."
        )
    return rigs[check_choice(f"camera of task {task!r}", camera, rigs)]


def rig_at_rest(camera: Camera) -> CameraRig:
    """Return the rig of a fixed camera."""
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
    """Return the camera of a rig in the world frame, for link origins ``xpos`` (L, 3) in metres."""
    follow = rig.track * xpos[rig.link] if rig.link >= 0 else jnp.zeros(3)
    eye, target = rig.eye + follow, rig.target + follow
    return Camera(pos=eye, xmat=spatial.look_at(eye, target, rig.up), fovy=jnp.asarray(rig.fovy))


def seen_from(geoms: Geoms, rig: CameraRig) -> Geoms:
    """Return the geoms with ``Geoms.distant`` set for the position of a rig."""
    with_far_form = [GeomKind(kind).has_far_form for kind in geoms.kind]
    radii = np.asarray(geoms.size)[with_far_form, 0]
    away = np.linalg.norm(np.asarray(rig.eye))
    return geoms.replace(distant=bool(len(radii) and away > _DISTANT * radii.min()))


def rig_from_corner(geoms: Geoms, xpos: np.ndarray, xquat: np.ndarray, link: int = 0) -> CameraRig:
    """Make a rig that shows all geoms but planes, from a corner and slightly from above.

    It follows ``link`` in x and y. ``xpos`` (L, 3) in metres and unit ``xquat`` (L, 4) are the
    poses of the links in the world frame.
    """
    points = [
        geoms.pos[g] if of < 0 else xpos[of] + spatial.rotate(xquat[of], geoms.pos[g])
        for g, of in enumerate(geoms.link)
        if geoms.kind[g] != GeomKind.PLANE
    ]
    places = np.stack([np.asarray(point) for point in points] + list(xpos[link : link + 1]))
    center = 0.5 * (places.min(axis=0) + places.max(axis=0))
    radius = max(float(np.linalg.norm(places - center, axis=1).max()), 0.1)
    eye = center + radius * np.array([2.0, -2.0, 1.2])
    rig = make_rig(eye.tolist(), center.tolist(), 50.0, link=link)
    # A rig's numbers are relative to the link that it follows.
    shift = np.array([xpos[link, 0], xpos[link, 1], 0.0], np.float32)
    return rig.replace(eye=rig.eye - shift, target=rig.target - shift)
