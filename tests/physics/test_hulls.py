"""Convex hulls of meshes, and what is left of them with few faces."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco.hulls import enclose

RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(400, 3)) * [0.3, 0.1, 0.2]
BOX = np.array(list(itertools.product((-1.0, 1.0), (-0.5, 0.5), (-0.1, 0.1))))
ICOSAHEDRON = np.array(
    [
        np.roll([0, a, b * (1 + 5**0.5) / 2], shift)
        for shift in range(3)
        for a in (-1, 1)
        for b in (-1, 1)
    ]
)


def outside(points, hull):
    """The largest distance of a point from the polytope's inside, 0 or less for none."""
    return (points @ hull.planes[:, :3].T - hull.planes[:, 3]).max()


@pytest.mark.parametrize(
    ("points", "faces"), [(np.eye(4)[:, :3], 4), (BOX, 6), (ICOSAHEDRON, 20)], ids=str
)
def test_few_facets_are_exact(points, faces):
    more = np.concatenate([points, points.mean(0) + 0.3 * (points - points.mean(0))])
    hull = enclose(more)
    assert hull.planes.shape == (faces, 4)
    assert hull.error == 0.0
    assert hull.radius == pytest.approx(np.linalg.norm(points, axis=1).max(), rel=1e-5)
    np.testing.assert_allclose(np.linalg.norm(hull.planes[:, :3], axis=1), 1.0, rtol=1e-5)
    # Each face has at least three of the corners.
    touching = np.abs(points @ hull.planes[:, :3].T - hull.planes[:, 3]) < 1e-5
    assert touching.sum(0).min() >= 3


def test_a_hull_contains_the_points_and_more_faces_are_nearer():
    hulls = [enclose(CLOUD, faces) for faces in (6, 8, 12, 24, 48)]
    errors = [hull.error for hull in hulls]
    for hull, faces in zip(hulls, (6, 8, 12, 24, 48), strict=True):
        assert len(hull.planes) <= faces
        assert outside(CLOUD, hull) <= 1e-6
        assert np.linalg.norm(CLOUD, axis=1).max() <= hull.radius + 1e-6
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.3 * errors[0]


def test_the_error_of_a_ball_in_a_box_is_that_of_a_corner():
    points = RNG.normal(size=(5000, 3))
    hull = enclose(points / np.linalg.norm(points, axis=1, keepdims=True), 6)
    assert hull.error == pytest.approx(3**0.5 - 1, abs=0.02)


@pytest.mark.parametrize("shape", [np.diag([1.0, 0.5, 0.0]), np.diag([1.0, 0.0, 0.0])])
def test_flat_points_get_a_thickness(shape):
    points = CLOUD @ shape + [1.0, 2.0, 3.0]
    hull = enclose(points)
    assert outside(points, hull) < 1e-6
    thickness = hull.planes[:, 3] - points[0] @ hull.planes[:, :3].T
    assert 0.0 < thickness.min() < 2e-3


def test_what_has_no_hull_is_told():
    with pytest.raises(ValueError, match=r"faces must be at least 6, .* got 5"):
        enclose(CLOUD, 5)
    for points in (CLOUD[:1], np.ones((5, 3)), np.full((5, 3), np.nan)):
        with pytest.raises(ValueError, match="at least two different ones"):
            enclose(points)
