"""Headlight, spot lights and the sky below the horizon, by their formulas."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.types import Lamp
from tests.renderer.scenes import from_above, scene_of
from tests.renderer.test_planes import RENDERERS, SIZE, ground_points

LAMP = Lamp(
    link=-1,
    exponent=10,
    pos=jnp.array([0.2, 0.1, 1.0]),
    axis=jnp.array([0.0, 0.0, -1.0]),
    cos_cutoff=jnp.float32(np.cos(np.deg2rad(40.0))),
    diffuse=jnp.float32(0.7),
    highlight=jnp.float32(0.0),
)
TURNED = jnp.array([1.0, -1.0, -1.0])
"""Of axes that look up instead of down."""
PLANE = (GeomKind.PLANE, (0.0, 0.0, 1.0), (0, 0, 0))


def lit(**changes):
    look = make_look("default").replace(
        light=None, ambient=jnp.float32(0.1), highlight=jnp.float32(0.0), **changes
    )
    return look.replace(ground_rgb=jnp.full((2, 3), 0.5))


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_lamp_on_a_plane(renderer):
    """Lambert's cosine times the cosine to the axis to the tenth, until the cutoff."""
    frame = render(scene_of(PLANE, look=lit(lamps=(LAMP,))), SIZE, SIZE, renderer)
    x, y = ground_points(2.0, 60.0)
    away = np.stack([x - 0.2, y - 0.1, np.full_like(x, -1.0)])
    cosine = 1.0 / np.linalg.norm(away, axis=0)
    strength = np.where(cosine > np.cos(np.deg2rad(40.0)), cosine**10, 0.0)
    expected = 0.5 * (0.1 + 0.7 * strength * cosine)
    # The fused renderer keeps 21 bits of a distance.
    near = np.abs(np.rad2deg(np.arccos(cosine)) - 40.0) > 0.5
    np.testing.assert_allclose(np.asarray(frame.r)[near], expected[near], atol=2e-3)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_lamps_shadow_grows_with_distance(renderer):
    """A ball half way between a lamp and the ground has a shadow of twice its tangent cone."""
    high = LAMP.replace(pos=jnp.array([0.0, 0.0, 1.0]), cos_cutoff=jnp.float32(-1.0), exponent=0)
    ball = (GeomKind.SPHERE, (0.1, 0, 0), (0, 0, 0.5))
    look = lit(lamps=(high,), shadows=True)
    camera = from_above(2.0)
    frame = render(scene_of(PLANE, ball, look=look, camera=camera), 80, 80, renderer)
    x, y = ground_points(2.0, 60.0, 80)
    radius = np.tan(np.arcsin(0.1 / 0.5))
    on_plane = np.asarray(frame.seg) == 0
    dark = np.asarray(frame.r) < 0.06
    edge = np.abs(np.hypot(x, y) - radius) < 0.03
    expected = (np.hypot(x, y) < radius) & on_plane
    np.testing.assert_array_equal(dark[on_plane & ~edge], expected[on_plane & ~edge])
    assert expected.sum() > 20


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_headlight_shines_along_the_view(renderer):
    look = lit(headlight=jnp.float32(0.8))
    sphere = (GeomKind.SPHERE, (0.5, 0, 0), (0, 0, 0))
    scene = scene_of(sphere, look=look)
    frame = render(scene, 41, 41, renderer)
    own = float(scene.geoms.rgb[0, 0])
    # In the middle the normal points at the camera; at the silhouette it is nearly across.
    assert frame.r[20, 20] == pytest.approx(own * (0.1 + 0.8), abs=1e-3)
    column = np.flatnonzero(np.asarray(frame.seg)[20] == 0)[0]
    slope = (column - 20) * 2 / 41 * np.tan(np.deg2rad(30))
    # The ray (slope, -1) from height 2 meets the sphere at t; the normal's z is z / radius.
    a, b, c = slope**2 + 1, 2.0, 4 - 0.25
    t = (b - np.sqrt(b * b - a * c)) / a
    assert frame.r[20, column] == pytest.approx(own * (0.1 + 0.8 * (2 - t) / 0.5), abs=4e-3)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_ground_is_lit_as_a_texture_is(renderer):
    """Ambient and headlight together are at most 1, and highlights are in the ground's color."""
    look = lit(headlight=jnp.float32(0.8), lamps=(LAMP.replace(highlight=jnp.float32(0.2)),))
    look = look.replace(ambient=jnp.float32(0.4), ground_rgb=jnp.array([[0.1, 0.2, 0.3]] * 2))
    frame = render(scene_of(PLANE, look=look), SIZE, SIZE, renderer)
    np.testing.assert_allclose(frame.g / frame.r, 2.0, rtol=1e-4)
    # A corner is beyond the lamp's cutoff: there is ambient light and headlight, 1.2 cut to 1.
    assert frame.r[-1, 0] == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_sky_of_three_colors(renderer):
    look = make_look("default").replace(sky=jnp.array([[0.5] * 3, [1.0] * 3, [0.0] * 3]))
    far = (GeomKind.SPHERE, (0.1, 0, 0), (0, 50.0, 0))
    level = from_above(0.0).replace(xmat=jnp.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]))
    frame = render(scene_of(far, look=look, camera=level), SIZE, 1, renderer)
    slope = -(np.arange(SIZE) + 0.5 - SIZE / 2) * 2 / SIZE * np.tan(np.deg2rad(30))
    rise = slope / np.hypot(1.0, slope)
    np.testing.assert_allclose(np.asarray(frame.g)[:, 0], 0.5 + 0.5 * rise, atol=1e-5)


def test_gradients_where_a_ray_meets_a_lamp_are_finite():
    """Light on the sky is computed at a metre, and its color then left out."""
    ahead = LAMP.replace(pos=jnp.array([0.0, 0.0, 1.0]))
    scene = scene_of(PLANE, look=lit(lamps=(ahead,), opengl=True), camera=from_above(2.0))
    scene = scene.replace(camera=scene.camera.replace(pos=jnp.zeros(3), xmat=jnp.diag(TURNED)))
    scene = jax.tree.map(jnp.asarray, scene)
    gradient = jax.jit(jax.grad(lambda s: jnp.sum(render(s, 3, 3).r)))(scene)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(gradient))


def test_gradients_of_lamps_are_finite():
    ball = (GeomKind.SPHERE, (0.2, 0, 0), (0.1, 0, 0.4))
    scene = scene_of(PLANE, ball, look=lit(lamps=(LAMP,), shadows=True))
    # One pixel right below the lamp, where its ray has no way across.
    scene = scene.replace(camera=scene.camera.replace(pos=jnp.array([0.2, 0.1, 2.0])))
    scene = jax.tree.map(jnp.asarray, scene)
    gradient = jax.jit(jax.grad(lambda s: jnp.sum(render(s, 9, 9).r)))(scene)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(gradient))
    assert float(jnp.abs(gradient.look.lamps[0].pos).max()) > 0
