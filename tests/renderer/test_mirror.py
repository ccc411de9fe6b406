"""What a plane reflects, by the optics of a mirror."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind
from pixelbrax_jax.renderer.base import render
from tests.renderer.scenes import camera, random_scene, scene_of
from tests.renderer.test_opengl import LAMP, LOOK
from tests.renderer.test_planes import RENDERERS

SIZE = 32
EYE = (0.0, -3.0, 1.5)
FLOOR = (GeomKind.PLANE, (2.0, 2.0, 0.2), (0, 0, 0))
BALL = (GeomKind.SPHERE, (0.3, 0, 0), (0.1, 0.2, 0.5))
EVEN = LOOK.replace(
    ambient=jnp.float32(1.0),
    headlight=None,
    headlight_highlight=None,
    lamps=(),
    reflectance=jnp.float32(0.25),
)
"""Ambient light alone: a color is a geom's own."""


def seen(*solids, look=EVEN, renderer="fused", **static):
    static = {"bounded": (True,) + (False,) * (len(solids) - 1), "mirror": 0} | static
    return render(
        scene_of(*solids, look=look, camera=camera(EYE, (0, 0, 0.2), 60.0), **static),
        SIZE,
        SIZE,
        renderer,
    )


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("renderer", [*RENDERERS, "pallas"])
def test_a_mirror_adds_a_part_of_what_mirrored_rays_see(renderer):
    frame = jax.tree.map(np.asarray, seen(FLOOR, BALL, renderer=renderer))
    plain = EVEN.replace(reflectance=None)
    bare = jax.tree.map(np.asarray, seen(FLOOR, BALL, look=plain, renderer=renderer))
    own = np.asarray(scene_of(FLOOR, BALL).geoms.rgb[1], float)
    view = camera(EYE, (0, 0, 0.2), 60.0)
    step = 2 * np.tan(np.deg2rad(30.0)) / SIZE
    reflecting = 0
    for row in range(SIZE):
        for column in range(SIZE):
            place = np.array([column - 0.5 * (SIZE - 1), 0.5 * (SIZE - 1) - row]) * step
            ray = np.asarray(view.xmat, float) @ np.array([*place, -1.0])
            expected = np.zeros(3)
            if frame.seg[row, column] == 0:
                point = np.array(EYE) - EYE[2] / ray[2] * ray
                up = ray * [1, 1, -1]
                away = np.array(BALL[2]) - point
                miss = np.linalg.norm(np.cross(up, away)) / np.linalg.norm(up)
                if abs(miss - 0.3) < 0.01:
                    continue
                if miss < 0.3 and away @ up > 0:
                    expected, reflecting = 0.25 * own, reflecting + 1
            added = [getattr(frame, c)[row, column] - getattr(bare, c)[row, column] for c in "rgb"]
            np.testing.assert_allclose(added, expected, atol=6e-4)  # 10 bits
    assert reflecting > 10


def test_what_reaches_below_the_mirror_is_cut_there():
    """The mirror image of a post through the floor begins where the post stands."""
    post = (GeomKind.CAPSULE, (0.15, 0.6, 0.0), (0.0, 0.0, 0.0))
    high = (GeomKind.CAPSULE, (0.15, 0.3, 0.0), (0.0, 0.0, 0.3))
    one, other = (seen(FLOOR, solid) for solid in (post, high))
    on_floor = np.asarray((one.seg == 0) & (other.seg == 0))
    np.testing.assert_allclose(
        np.asarray(one.g)[on_floor], np.asarray(other.g)[on_floor], atol=1.1e-3
    )


def test_the_sky_and_other_ground_are_not_reflected():
    wall = (GeomKind.PLANE, (2.0, 2.0, 0.2), (0.0, 1.0, 0.0))
    none = EVEN.replace(reflectance=None)
    for solids in ((FLOOR,), (FLOOR, wall)):
        static = {"bounded": (True,) * len(solids)}
        mirrored, plain = (seen(*solids, look=look, **static) for look in (EVEN, none))
        np.testing.assert_array_equal(mirrored.b, plain.b)


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize(
    ("seed", "mirror"),
    [
        (0, 0),
        pytest.param(3, 0, marks=pytest.mark.slow),
        pytest.param(2, None, marks=pytest.mark.slow),
    ],
)
def test_renderers_agree_with_all_lights_and_shadows(seed, mirror):
    look = LOOK.replace(
        light=jnp.array([-0.3, -0.5, 1.0]),
        diffuse=jnp.float32(0.3),
        highlight=jnp.float32(0.15),
        ambient=jnp.float32(0.3),
        reflectance=None if mirror is None else jnp.float32(0.5),
        lamps=(LAMP.replace(cos_cutoff=jnp.float32(-1.0), exponent=0),),
    )
    scene = random_scene(seed, look)
    others = len(scene.geoms.kind) - 1
    geoms = scene.geoms.replace(
        bounded=(True,) + (False,) * others,
        textured=(False, True) + (False,) * (others - 1),
        mirror=mirror,
        size=scene.geoms.size.at[0].set(jnp.array([1.5, 2.0, 0.4])),
    )
    frames = [render(scene.replace(geoms=geoms), 40, 40, name) for name in (*RENDERERS, "pallas")]
    for frame in frames[1:]:
        same = np.asarray(frames[0].seg == frame.seg)
        assert same.mean() > 0.998
        off = np.max([np.abs(getattr(frame, c) - getattr(frames[0], c)) for c in "rgb"], axis=0)
        assert (off[same] > 2 / 255).mean() < (0.006 if mirror is None else 0.008)


@pytest.mark.slow
def test_gradients_are_finite():
    scene = scene_of(
        FLOOR, BALL, look=LOOK.replace(reflectance=jnp.float32(0.2)), mirror=0,
        bounded=(True, False), camera=camera(EYE),
    )  # fmt: skip
    gradient = jax.jit(jax.grad(lambda s: jnp.sum(render(s, 9, 9).r)))(
        jax.tree.map(jnp.asarray, scene)
    )
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(gradient))
    assert float(gradient.look.reflectance) > 0
    assert float(jnp.abs(gradient.look.headlight_highlight)) > 0
