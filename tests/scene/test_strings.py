"""Threads: their ends, their length, and the shape in which they hang."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, Geoms, make_look, make_rig
from pixelbrax_jax.scene.place import hang, place
from pixelbrax_jax.types import Lamp, String

LENGTH = 0.3
hang_jit = jax.jit(hang, static_argnums=2)


@pytest.mark.parametrize(
    "end", [(0.2, 0, 0), (0.1, 0.05, -0.2), (0, 0, 0.1), (0, 0, -0.29), (0.25, 0, 0.15), (0, 0, 0)]
)
def test_a_hanging_thread_has_its_length_and_its_ends(end):
    start = np.array([0.3, -0.2, 1.0])
    ends = jnp.array([start, start + end], jnp.float32)
    points = np.asarray(hang_jit(ends, jnp.float32(LENGTH), 64), np.float64)
    np.testing.assert_allclose(points[[0, -1]], ends, atol=2e-4)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Where it turns back at once, the turn is inside of one of the 64 steps.
    assert steps.sum() == pytest.approx(LENGTH, rel=1 / 64)
    assert points[:, 2].min() <= min(points[0, 2], points[-1, 2]) + 1e-6


def test_the_shape_is_a_catenary():
    """Of a thread over a horizontal span, the sag solves the textbook's pair of equations."""
    a, h = 0.1, 0.15
    length, sag = 2 * a * np.sinh(h / (2 * a)), a * (np.cosh(h / (2 * a)) - 1)
    ends = jnp.array([[0, 0, 1.0], [h, 0, 1.0]], jnp.float32)
    points = np.asarray(hang_jit(ends, jnp.float32(length), 64))
    assert 1.0 - points[:, 2].min() == pytest.approx(sag, rel=1e-2)
    middle = points[32]
    np.testing.assert_allclose(middle, [h / 2, 0, 1.0 - sag], atol=1e-4)


def test_a_stretched_thread_is_straight():
    ends = jnp.array([[0, 0, 1.0], [0.3, 0.1, 0.6]], jnp.float32)
    for length in (0.0, LENGTH):
        points = np.asarray(hang_jit(ends, jnp.float32(length), 4))
        expected = np.linspace(ends[0], ends[1], 5)
        np.testing.assert_allclose(points, expected, atol=1e-6)


@pytest.mark.parametrize("end", [(0.2, 0, 0), (0, 0, 0), (0, 0, -0.3), (0.4, 0, 0)])
def test_derivatives_are_finite(end):
    ends = jnp.array([[0, 0, 1.0], [end[0], end[1], 1.0 + end[2]]], jnp.float32)
    jacobian = jax.jacobian(lambda e: hang(e, jnp.float32(LENGTH), 4))(ends)
    assert bool(jnp.isfinite(jacobian).all())


def test_place_stretches_strings_and_carries_lamps():
    geoms = Geoms(
        kind=(int(GeomKind.CAPSULE),) * 3,
        link=(-1,) * 3,
        material=(0,) * 3,
        name=("a", "b", "c"),
        size=jnp.array([[0.01, 0.0, 0.0]] * 3),
        pos=jnp.zeros((3, 3)),
        quat=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (3, 1)),
        rgb=jnp.ones((1, 3)),
        strings=(
            String(
                geoms=(0, 1, 2),
                link=(-1, 1),
                ends=jnp.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.5]]),
                length=jnp.float32(0.0),
            ),
        ),
    )
    lamp = Lamp(
        link=1,
        exponent=1,
        pos=jnp.array([0.0, 0.0, 3.0]),
        axis=jnp.array([0.0, 0.0, -1.0]),
        cos_cutoff=jnp.float32(-1.0),
        diffuse=jnp.float32(1.0),
        highlight=jnp.float32(0.0),
    )
    look = make_look("default").replace(lamps=(lamp,))
    xpos = jnp.array([[9.0, 9.0, 9.0], [3.0, 0.0, 2.0]])
    half_turn = jnp.array([[1.0, 0, 0, 0], [0.0, 1.0, 0.0, 0.0]])  # about x: its z is down
    view = make_rig((0, -4, 1), (0, 0, 1), 45.0)
    scene = place(geoms, view, look, xpos, half_turn)
    # From (0, 0, 2) to link 1's (3, 0, 2) and 0.5 down.
    end = np.array([3.0, 0.0, 1.5])
    fractions = np.array([1, 3, 5])[:, None] / 6
    expected = np.array([0, 0, 2.0]) + fractions * (end - [0, 0, 2.0])
    np.testing.assert_allclose(scene.pos, expected, atol=1e-5)
    length = np.linalg.norm(end - [0, 0, 2.0])
    np.testing.assert_allclose(scene.geoms.size[:, 1], length / 6, rtol=1e-5)
    along = scene.xmat[:, :, 2] * length
    np.testing.assert_allclose(along, np.tile(end - [0, 0, 2.0], (3, 1)), atol=1e-5)
    for axes in np.asarray(scene.xmat):
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(scene.look.lamps[0].pos, [3.0, 0.0, 5.0])
