"""Planes that end, and planes that are no ground."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.types import FAR
from tests.renderer import scenes
from tests.renderer.scenes import scene_of

SIZE = 40
RENDERERS = ("fused", "reference")
HALF = (0.5, 0.25)


def ground_points(height, fovy, size=SIZE):
    """Where the pixels' rays meet z = 0, by the pinhole model."""
    slope = (np.arange(size) + 0.5 - size / 2) * 2 / size * np.tan(np.deg2rad(fovy) / 2)
    x, y = np.meshgrid(slope * height, -slope * height)
    return x, y


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize(
    ("size", "ends"),
    [(HALF, HALF), ((0.5, 0.0), (0.5, np.inf)), ((0.0, 0.25), (np.inf, 0.25)), ((0, 0), None)],
)
def test_a_plane_is_seen_inside_its_bounds_alone(renderer, size, ends):
    plane = (GeomKind.PLANE, (*size, 1.0), (0, 0, 0))
    frame = render(scene_of(plane, bounded=(True,)), SIZE, SIZE, renderer)
    x, y = ground_points(2.0, 60.0)
    ends = ends or (np.inf, np.inf)
    inside = (np.abs(x) <= ends[0]) & (np.abs(y) <= ends[1])
    np.testing.assert_array_equal(np.asarray(frame.seg) == 0, inside)
    np.testing.assert_array_equal(np.asarray(frame.ground), inside)
    np.testing.assert_allclose(np.asarray(frame.depth)[inside], 2.0, rtol=1e-4)
    assert (np.asarray(frame.depth)[~inside] == FAR).all()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_size_is_no_bound_where_planes_do_not_end(renderer):
    plane = (GeomKind.PLANE, (*HALF, 1.0), (0, 0, 0))
    assert (np.asarray(render(scene_of(plane), SIZE, SIZE, renderer).seg) == 0).all()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_edge_belongs_to_the_plane(renderer):
    # The middle ray of an odd image, moved to the edge: 0.5 has an exact float.
    plane = (GeomKind.PLANE, (*HALF, 1.0), (-0.5, 0, 0))
    seen = scene_of(plane, bounded=(True,))
    assert int(render(seen, 1, 1, renderer).seg[0, 0]) == 0
    beyond = seen.replace(pos=seen.pos - jnp.array([1e-3, 0.0, 0.0]))
    assert int(render(beyond, 1, 1, renderer).seg[0, 0]) == -1


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_shadow_ends_with_the_plane_and_planes_cast_none(renderer):
    look = make_look("default", shadows=True)
    look = look.replace(light=jnp.array([0.0, 0.0, 1.0]), ground_rgb=jnp.full((2, 3), 0.4))
    lower, ball = (
        (GeomKind.PLANE, (0, 0, 1), (0, 0, -1.0)),
        (GeomKind.SPHERE, (0.2, 0, 0), (0, 0, 1)),
    )
    eye = scenes.camera((0.0, -4.0, 4.0), (0.0, 0.0, -0.5), 40.0)
    # Light passes planes: the ball's shadow is on both, or beside the upper one on the lower alone.
    for upper_at, on in ((0.0, {0, 1}), (2.0, {0})):
        upper = (GeomKind.PLANE, (*HALF, 1.0), (upper_at, 0, 0))
        scene = scene_of(lower, upper, ball, look=look, camera=eye, bounded=(True, True, False))
        frame = render(scene, 96, 96, renderer)
        bare = render(scene.replace(look=look.replace(shadows=False)), 96, 96, renderer)
        darker = np.asarray(frame.r) < np.asarray(bare.r) - 0.05
        assert {int(geom) for geom in np.asarray(frame.seg)[darker]} == on


@pytest.mark.parametrize("renderer", RENDERERS)
def test_only_ground_has_the_pattern(renderer):
    planes = [(GeomKind.PLANE, (0.5, 0.5, 1.0), (x, 0, 0)) for x in (-0.6, 0.6)]
    scene = scene_of(*planes, bounded=(True, True), patterned=(True, False))
    frame = render(scene, SIZE, SIZE, renderer)
    seg, ground = np.asarray(frame.seg), np.asarray(frame.ground)
    np.testing.assert_array_equal(ground, seg == 0)
    lit = np.asarray(frame.g)
    assert np.ptp(lit[seg == 0]) > 0.05
    # One color and one normal; only the gloss may differ, and it does not from above.
    assert np.ptp(lit[seg == 1]) < 0.02
    ratio = np.asarray(frame.b)[seg == 1] / np.asarray(frame.r)[seg == 1]
    own = scene.geoms.rgb[1, 2] / scene.geoms.rgb[1, 0]
    # A white highlight pulls the ratio of the colors towards 1.
    assert 1.0 <= ratio.min() <= own + 1e-4


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_pattern_begins_at_the_corner(renderer):
    """At least x and greatest y is the first color; without bounds the middle is a corner."""
    look = make_look("dmc", shadows=False).replace(ground_pitch=jnp.float32(0.4))
    plane = (GeomKind.PLANE, (0.5, 0.3, 1.0), (0, 0, 0))
    frame = render(scene_of(plane, look=look, bounded=(True,)), 80, 80, renderer)
    x, y = ground_points(2.0, 60.0, 80)
    inside = (np.abs(x) < 0.5) & (np.abs(y) < 0.3)
    tile = np.floor((x + 0.5) / 0.4) + np.floor((0.3 - y) / 0.4)
    expected = np.where(tile % 2 == 0, *(float(look.ground_rgb[k, 2]) for k in (0, 1)))
    # Away from edges of tiles, which are averaged over a pixel.
    pixel = x[0, 1] - x[0, 0]
    for at in ((x + 0.5) % 0.4, (0.3 - y) % 0.4):
        inside &= np.abs(at - 0.2) < 0.2 - pixel
    ratio = np.asarray(frame.b)[inside] / expected[inside]
    assert inside.sum() > 100
    assert np.ptp(ratio) < 0.15 * ratio.mean()


def random_strip(seed):
    """All primitives over a strip and a plain wall, with lamps, in MuJoCo's light."""
    look = make_look("dmc")
    scene = scenes.random_scene(seed, look)
    geoms = scene.geoms
    count = len(geoms.kind)
    wall = jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).T
    geoms = geoms.replace(
        kind=(*geoms.kind, int(GeomKind.PLANE)),
        link=(*geoms.link, -1),
        material=(*geoms.material, count),
        name=(*geoms.name, "wall"),
        size=jnp.concatenate(
            [geoms.size.at[0].set(jnp.array([1.2, 0.9, 1.0])), jnp.array([[0.4, 0.9, 1.0]])]
        ),
        pos=jnp.zeros((count + 1, 3)),
        quat=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count + 1, 1)),
        rgb=jnp.concatenate([geoms.rgb, jnp.array([[0.3, 0.5, 0.7]])]),
        bounded=(True, *(False,) * (count - 1), True),
        patterned=(True,) + (False,) * count,
    )
    return scene.replace(
        geoms=geoms,
        pos=jnp.concatenate([scene.pos, jnp.array([[0.0, 0.9, 0.4]])]),
        xmat=jnp.concatenate([scene.xmat, wall[None]]),
    )


def test_fused_draws_what_the_reference_draws():
    draw = jax.jit(render, static_argnums=(1, 2, 3))
    for seed in range(4):
        scene = random_strip(seed)
        scenes.assert_alike(*(draw(scene, SIZE, SIZE, name) for name in RENDERERS), colors=0.005)
