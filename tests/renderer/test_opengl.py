"""Light as MuJoCo's OpenGL renderer computes it, by its formulas at single points."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.renderer.opengl import on_plane
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.spatial import make_rig
from pixelbrax_jax.types import Lamp
from tests.renderer.scenes import geoms_of, scene_of
from tests.renderer.test_planes import RENDERERS, ground_points

SIZE = 24
LAMP = Lamp(
    link=-1,
    exponent=10,
    pos=jnp.array([0.3, 0.2, 1.0]),
    axis=jnp.array([0.0, 0.0, -1.0]),
    cos_cutoff=jnp.float32(np.cos(np.deg2rad(45.0))),
    diffuse=jnp.float32(0.5),
    highlight=jnp.float32(0.2),
)
EYE = np.array([0.0, 0.0, 2.0])
BACK = np.array([0.0, 0.0, 1.0])
LOOK = make_look("dmc").replace(
    light=None,
    ambient=jnp.float32(0.1),
    headlight=jnp.float32(0.3),
    headlight_highlight=jnp.float32(0.05),
    highlight=jnp.float32(0.0),
    lamps=(LAMP,),
    ground_rgb=jnp.full((2, 3), 0.5),
    shininess=64,
    opengl=True,
    ground_mark=jnp.float32(0.05),
)


def unit(vector):
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def gloss(point, normal, to_light):
    half = unit(to_light + unit(EYE - point))
    lit = np.sum(normal * to_light, -1) > 0
    return np.where(lit, np.maximum(np.sum(normal * half, -1), 0) ** 64, 0.0)


def passes(point, normal):
    """Factor of color and highlight of the headlight's pass, and of the lamp's."""
    head = 0.1 + 0.3 * np.maximum(normal @ BACK, 0), 0.05 * gloss(point, normal, BACK)
    to_lamp = unit(np.asarray(LAMP.pos, float) - point)
    along = to_lamp[..., 2]
    strength = np.where(along >= np.cos(np.deg2rad(45.0)), along**10, 0.0)
    n_l = np.maximum(np.sum(normal * to_lamp, -1), 0)
    return head, (strength * 0.5 * n_l, strength * 0.2 * gloss(point, normal, to_lamp))


def on_vertex(x, y):
    """Light on the plane's texture at a vertex: each pass is at most 1."""
    point = np.stack([x, y, np.zeros_like(x)], -1)
    return sum(
        np.minimum(sum(pair), 1.0) for pair in passes(point, np.broadcast_to(BACK, point.shape))
    )


def interpolated(x, y, ends_x, ends_y):
    """The plane of three corners of a cell, on the side of the diagonal where (x, y) is."""
    k, j = (np.searchsorted(ends, at, side="right") - 1 for ends, at in ((ends_x, x), (ends_y, y)))
    (x0, x1), (y0, y1) = (ends_x[k], ends_x[k + 1]), (ends_y[j], ends_y[j + 1])
    u, v = (x - x0) / (x1 - x0), (y - y0) / (y1 - y0)
    right, left = on_vertex(x1, y0), on_vertex(x0, y1)
    if u + v <= 1:
        corner = on_vertex(x0, y0)
        return corner + u * (right - corner) + v * (left - corner)
    corner = on_vertex(x1, y1)
    return corner + (1 - u) * (left - corner) + (1 - v) * (right - corner)


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("renderer", [*RENDERERS, "pallas"])
def test_a_plane_is_lit_at_the_vertices_of_its_grid(renderer):
    """Along x six cells of 0.5 and 0.2 m for the rest at both ends; along y two cells of 0.9 m."""
    size = (1.7, 0.9, 0.25)
    plane = (GeomKind.PLANE, size, (0, 0, 0))
    frame = render(scene_of(plane, look=LOOK, bounded=(True,)), SIZE, SIZE, renderer)
    ends_x = np.array([-1.7, *np.arange(-1.5, 1.6, 0.5), 1.7])
    ends_y = np.array([-0.9, *np.arange(-0.5, 0.6, 0.5), 0.9])
    x, y = ground_points(2.0, 60.0, SIZE)
    seen = 0
    for row in range(SIZE):
        for column in range(SIZE):
            if frame.seg[row, column] == 0:
                light = interpolated(x[row, column], y[row, column], ends_x, ends_y)
                assert frame.r[row, column] == pytest.approx(0.5 * min(light, 2.0), abs=2e-3)
                seen += 1
    assert seen > 200
    # A light for each point would differ.
    assert abs(interpolated(0.3, 0.2, ends_x, ends_y) - on_vertex(0.3, 0.2)) > 0.03


def test_light_on_a_ground_is_computed_once_for_cameras_that_do_not_move():
    geoms = geoms_of(
        [GeomKind.PLANE, GeomKind.SPHERE], [(2.0, 2.0, 0.2), (0.1, 0.0, 0.0)], bounded=(True, False)
    ).replace(link=(-1, 0))

    def roots(link):
        """Numbers of roots of all pixels of one image, and of each image of a batch."""
        rig = make_rig((0, -3, 1), (0, 0, 1), 45.0, link=link)

        def red(xpos):
            xquat = jnp.array([[1.0, 0.0, 0.0, 0.0]])
            return render(place(geoms, rig, LOOK, xpos, xquat), 5, 5, "fused").r

        program = jax.jit(jax.vmap(red)).lower(jnp.zeros((7, 1, 3))).as_text()
        lines = [line for line in program.splitlines() if "stablehlo.rsqrt" in line]
        return [sum(shape in line for line in lines) for shape in ("<25xf32>", "<7x25xf32>")]

    (once, each), (moving_once, moving_each) = roots(-1), roots(0)
    # At three vertices the way to the eye, both highlights, and the way to the lamp.
    assert once - moving_once == moving_each - each == 12


def test_cells_are_not_smaller_than_a_part_of_the_plane():
    """A plane of 250 m has cells of 250 / 99 m; the light of x is linear between them."""

    def height(ray, point, normal):
        return 0.5 + 1e-4 * point[0] ** 2, 0.0

    width = 250.0 / 99
    place = np.float32([0.0, 0.25, 0.5, 1.0]) * np.float32(width) + np.float32(3 * width)
    axes = tuple(map(tuple, np.eye(3)))
    size = (jnp.float32(250.0), jnp.float32(0.8), jnp.float32(0.2))
    found = on_plane([height], (0.0, 0.0, 5.0), (0.0, 0.0, 0.0), axes, size, (place, 0 * place))
    ends = 0.5 + 1e-4 * (np.array([3, 4]) * width) ** 2
    expected = ends[0] + np.array([0.0, 0.25, 0.5, 1.0]) * (ends[1] - ends[0])
    np.testing.assert_allclose(found[0], expected, rtol=1e-5)


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("renderer", [*RENDERERS, "pallas"])
def test_a_sphere_has_highlights_of_half_vectors(renderer):
    sphere = (GeomKind.SPHERE, (0.7, 0, 0), (0, 0, 0))
    scene = scene_of(sphere, look=LOOK)
    frame = render(scene, SIZE, SIZE, renderer)
    own = np.asarray(scene.geoms.rgb[0], float)
    slope, _ = ground_points(1.0, 60.0, SIZE)
    row, columns = SIZE // 2, range(6, SIZE - 6)
    brightest = 0.0
    for column in columns:
        ray = np.array([slope[row, column], slope[row, column], -1.0])
        ray[1] = -slope[0, row]
        # |EYE + t ray| = 0.7
        a, b, c = ray @ ray, EYE @ ray, 4 - 0.49
        point = EYE + (-b - np.sqrt(b * b - a * c)) / a * ray
        pairs = passes(point, point / 0.7)
        factor, highlight = (sum(part) for part in zip(*pairs, strict=True))
        expected = np.clip(own * factor + highlight, 0, 1)
        found = [plane[row, column] for plane in (frame.r, frame.g, frame.b)]
        np.testing.assert_allclose(found, expected, atol=3e-3)
        brightest = max(brightest, highlight)
    assert brightest > 0.03
