"""Convex hulls of meshes, as few half-spaces that contain them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from pixelbrax_jax.physics.mujoco.opengl import mujoco

FACES = 24
"""Half-spaces of a mesh, at most."""

_BOX = 6

_THIN = 1e-3
"""Least extent along a principal axis, as a fraction of the largest one."""

_EXACT = 1e-5
"""Distances that count as zero, as a fraction of the largest extent: the vertices are float32."""


class Hull(NamedTuple):
    """A convex polytope around a mesh, in metres.

    ``planes`` (K, 4) float32 are outer unit normals and distances from the origin. ``radius`` and
    ``error`` are a corner's largest distances from the origin and from the mesh's convex hull.
    """

    planes: np.ndarray
    radius: float
    error: float


def mesh_hull(model: mujoco.MjModel, mesh: int) -> Hull:
    """Return the hull of a model's mesh, in the frame of its geoms."""
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = np.ascontiguousarray(model.mesh_vert[first : first + count], np.float32)
    return _of_bytes(vertices.tobytes())


# A model is read more than once, and large meshes take a tenth of a second.
@lru_cache(maxsize=64)
def _of_bytes(vertices: bytes) -> Hull:
    return enclose(np.frombuffer(vertices, np.float32).reshape(-1, 3))


def enclose(points: np.ndarray, faces: int = FACES) -> Hull:
    """Enclose points (N, 3), in metres, in at most ``faces`` half-spaces.

    A hull with no more facets is exact. Otherwise the first half-spaces are a box along the
    principal axes, and the facet is added that cuts deepest into the polytope, until there are
    enough. Points in a plane or on a line get a thickness of a thousandth of their extent.
    """
    if faces < _BOX:
        raise ValueError(f"faces must be at least {_BOX}, the faces of a box, got {faces}.")
    points = np.asarray(points, np.float64)
    if len(points) < 2 or not np.isfinite(points).all() or not np.ptp(points, axis=0).any():
        raise ValueError("the points must be finite, and at least two different ones.")
    _, axes = np.linalg.eigh(np.cov(points.T))
    axes = axes.T
    extent = np.ptp(points @ axes.T, axis=0)
    size = extent.max()
    for axis, length in zip(axes, extent, strict=True):
        if length < _THIN * size:
            points = np.concatenate([points + s * 0.5 * _THIN * size * axis for s in (-1, 1)])
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    center = corners.mean(0)
    normals = hull.equations[:, :3]
    _, rows = np.unique(normals.round(4), axis=0, return_index=True)
    facets = _touching(normals[rows], corners)
    chosen = facets
    if len(facets) > faces:
        chosen = _touching(np.concatenate([axes, -axes]), corners)
        while len(chosen) < faces:
            outer, _ = _intersect(chosen, center)
            depth = (outer @ facets[:, :3].T - facets[:, 3]).max(axis=0)
            if depth.max() <= _EXACT * size:
                break
            chosen = np.concatenate([chosen, facets[depth.argmax()][None]])
            chosen = chosen[_intersect(chosen, center)[1]]
    outer, _ = _intersect(chosen, center)
    error = max(_distance(corner, corners) for corner in outer)
    return Hull(
        planes=chosen.astype(np.float32),
        radius=float(np.linalg.norm(outer, axis=1).max()),
        error=0.0 if error <= _EXACT * size else float(error),
    )


def _touching(normals: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return half-spaces (K, 4) with outer ``normals`` that contain all corners and touch one."""
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([normals, (corners @ normals.T).max(axis=0)])


def _intersect(planes: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (C, 3) of half-spaces around ``center``, and the rows that bound them."""
    # Planes and points are dual: n.x <= c is the point n / c, a facet m.p <= k the corner m / k.
    normals = planes[:, :3]
    dual = ConvexHull(normals / (planes[:, 3] - normals @ center)[:, None])
    return center - dual.equations[:, :3] / dual.equations[:, 3:], np.sort(dual.vertices)


def _distance(point: np.ndarray, corners: np.ndarray) -> float:
    """Return the distance of a point from the convex hull of corners (N, 3)."""
    # The nearest mean of the corners; the last row makes the sum of the weights 1.
    offsets = (corners - point).T
    scale = np.abs(offsets).max()
    rows = np.concatenate([offsets / scale, np.full((1, len(corners)), 1e3)])
    weights, _ = nnls(rows, np.array([0.0, 0.0, 0.0, 1e3]))
    return float(np.linalg.norm(offsets @ (weights / weights.sum())))
