"""Camera rigs, and the cameras they give."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.spatial import check_rig, f32, look_at, make_rig, rotate
from pixelbrax_jax.types import Camera, CameraRig, GeomKind, Geoms
from pixelbrax_jax.validation import check_arrays, check_choice

_DISTANT = 1000
"""Radii of a sphere or capsule beyond which float32 moves its edge by hundredths of a radius."""


_Direction = tuple[float, float, float]

_SIDES: Mapping[str, tuple[_Direction, _Direction]] = {
    "side": ((0.0, -1.0, 0.15), (0.0, 0.0, 1.0)),
    "front": ((1.0, 0.0, 0.15), (0.0, 0.0, 1.0)),
    "top": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
}
"""Views of a task besides ``default``, with its target and distance: direction to the eye, up."""


def with_sides(rigs: Mapping[str, CameraRig]) -> dict[str, CameraRig]:
    """Return ``default``, ``side``, ``front`` and ``top``, and other rigs, which override them."""
    default = rigs["default"]
    distance = np.float32(np.linalg.norm(default.eye - default.target))
    sides = {}
    for name, (direction, up) in _SIDES.items():
        away = np.array(direction) / np.linalg.norm(direction)
        eye = default.target + distance * away.astype(np.float32)
        sides[name] = default.replace(eye=eye, up=f32(up))
    return {"default": default, **sides, **rigs}


def choose_rig(
    task: str, camera: str | CameraRig | Camera, rigs: Mapping[str, CameraRig]
) -> CameraRig:
    """Return a rig by name, the given rig, or a rig for a fixed camera."""
    if isinstance(camera, CameraRig):
        return check_rig(camera)
    if isinstance(camera, Camera):
        parts = check_arrays("a Camera", camera, {"pos": (3,), "xmat": (3, 3), "fovy": ()})
        pos, xmat = parts["pos"], parts["xmat"]
        return make_rig(pos, pos - xmat[:, 2], parts["fovy"].item(), up=xmat[:, 1])
    if not isinstance(camera, str):
        raise TypeError(
            "camera must be a name, a pixelbrax_jax.CameraRig or a pixelbrax_jax.Camera, "
            f"got {camera!r}; names: {', '.join(sorted(rigs))}."
        )
    return rigs[check_choice(f"camera of task {task!r}", camera, rigs)]


def aim(rig: CameraRig, xpos: jax.Array) -> Camera:
    """Return the camera of a rig in the world frame, for link origins ``xpos`` (L, 3) in metres."""
    follow = rig.track * xpos[rig.link] if rig.link >= 0 else jnp.zeros(3)
    eye, target = rig.eye + follow, rig.target + follow
    return Camera(pos=eye, xmat=look_at(eye, target, rig.up), fovy=jnp.asarray(rig.fovy))


def seen_from(geoms: Geoms, *rigs: CameraRig) -> Geoms:
    """Return the geoms with ``Geoms.distant`` set for the positions of the rigs."""
    with_far_form = [GeomKind(kind).has_far_form for kind in geoms.kind]
    radii = np.asarray(geoms.size)[with_far_form, 0]
    away = max(np.linalg.norm(np.asarray(rig.eye)) for rig in rigs)
    return geoms.replace(distant=bool(len(radii) and away > _DISTANT * radii.min()))


def rig_from_corner(geoms: Geoms, xpos: np.ndarray, xquat: np.ndarray, link: int = 0) -> CameraRig:
    """Make a rig that shows all geoms but planes, from a corner and slightly from above.

    It follows ``link`` in x and y. ``xpos`` (L, 3) in metres and unit ``xquat`` (L, 4) are the
    poses of the links in the world frame.
    """
    points = [
        geoms.pos[g] if of < 0 else xpos[of] + rotate(xquat[of], geoms.pos[g])
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
