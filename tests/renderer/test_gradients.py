"""Derivatives of float frames: finite everywhere, right inside surfaces."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.renderer.base import render
from tests.renderer import scenes
from tests.renderer.test_planes import random_strip

SIZE = 24
STEP = 1e-3


def colors_and_depth(scene):
    frame = render(scene, SIZE, SIZE)
    depth = jnp.where(frame.seg >= 0, frame.depth, 0.0)
    return jnp.stack([frame.r, frame.g, frame.b, depth]), frame.seg


@pytest.fixture(scope="module")
def program():
    return jax.jit(colors_and_depth)


@pytest.fixture(scope="module")
def directional():
    def derivative(scene, tangent):
        return jax.jvp(lambda s: colors_and_depth(s)[0], (scene,), (tangent,))[1]

    return jax.jit(derivative)


def zeros_like(scene):
    return jax.tree.map(jnp.zeros_like, scene)


DIRECTIONS = {
    "geom positions": lambda z, v: z.replace(pos=v(z.pos)),
    "geom orientations": lambda z, v: z.replace(xmat=v(z.xmat)),
    "colors": lambda z, v: z.replace(geoms=z.geoms.replace(rgb=v(z.geoms.rgb))),
    "sizes": lambda z, v: z.replace(geoms=z.geoms.replace(size=v(z.geoms.size))),
    "camera position": lambda z, v: z.replace(camera=z.camera.replace(pos=v(z.camera.pos))),
    "field of view": lambda z, v: z.replace(camera=z.camera.replace(fovy=v(z.camera.fovy))),
    "light": lambda z, v: z.replace(look=z.look.replace(light=v(z.look.light))),
    "sky": lambda z, v: z.replace(look=z.look.replace(sky=v(z.look.sky))),
}


def interior(seg: np.ndarray) -> np.ndarray:
    """Pixels whose neighbors show the same geom."""
    padded = np.pad(seg, 1, mode="edge")
    same = np.ones_like(seg, bool)
    for dy in (0, 1, 2):
        for dx in (0, 1, 2):
            same &= padded[dy : dy + SIZE, dx : dx + SIZE] == seg
    return same


def derivatives_inside(program, directional, scene, tangent):
    """Derivatives, and finite differences, of the pixels that stay inside a geom, (4, P) each."""
    ahead, seg_ahead = program(jax.tree.map(lambda x, d: x + STEP * d, scene, tangent))
    behind, seg_behind = program(jax.tree.map(lambda x, d: x - STEP * d, scene, tangent))
    seg = np.asarray(program(scene)[1])
    exact = np.asarray(directional(scene, tangent))
    assert np.isfinite(exact).all()
    calm = interior(seg) & (np.asarray(seg_ahead) == seg) & (np.asarray(seg_behind) == seg)
    return exact[:, calm], np.asarray(ahead - behind)[:, calm] / (2 * STEP)


def are_apart(exact, numeric):
    return np.abs(exact - numeric) > 0.05 * (0.05 + np.abs(numeric))


@pytest.mark.parametrize("what", DIRECTIONS)
def test_matches_finite_differences_inside_geoms(program, directional, what):
    rng = np.random.default_rng(0)
    # No pattern and no gloss: their kinks are not what is tested here.
    look = make_look("default")
    look = look.replace(ground_rgb=look.ground_rgb[:1].repeat(2, 0), highlight=np.float32(0.0))
    checked = 0
    for seed in range(3):
        scene = jax.tree.map(jnp.asarray, scenes.random_scene(seed, look))
        tangent = DIRECTIONS[what](
            zeros_like(scene), lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32)
        )
        if what == "geom orientations":
            # Stay among rotations: turn each geom about a random axis.
            spin = tangent.xmat - jnp.swapaxes(tangent.xmat, -1, -2)
            tangent = tangent.replace(xmat=spin @ scene.xmat)
        if what == "field of view":
            tangent = jax.tree.map(lambda x: 20 * x, tangent)  # degrees
        exact, numeric = derivatives_inside(program, directional, scene, tangent)
        # A pixel next to a light's terminator or a clipped color has a kink of its own.
        assert np.mean(are_apart(exact, numeric)) < 0.02
        checked += exact.shape[1] * (np.abs(numeric).max() > 1e-3)
    assert checked > SIZE


@pytest.mark.slow
def test_planes_that_end_and_lamps_have_derivatives(program, directional):
    rng, checked = np.random.default_rng(0), 0
    for seed in range(2):
        scene = random_strip(seed)
        look = scene.look.replace(
            ground_rgb=scene.look.ground_rgb[:1].repeat(2, 0),
            highlight=np.float32(0.0),
            shadows=False,
        )
        scene = jax.tree.map(jnp.asarray, scene.replace(look=look))
        reverse = jax.grad(lambda s: jnp.sum(colors_and_depth(s)[0] ** 2))
        assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(jax.jit(reverse)(scene)))
        pos, size = (
            jnp.asarray(rng.normal(size=x.shape), jnp.float32)
            for x in (scene.pos, scene.geoms.size)
        )
        zero = zeros_like(scene)
        tangent = zero.replace(pos=pos, geoms=zero.geoms.replace(size=size))
        exact, numeric = derivatives_inside(program, directional, scene, tangent)
        # A kink of the lights' clipping is not what is tested.
        assert np.mean(are_apart(exact, numeric)) < 0.03
        checked += exact.shape[1]
    assert checked > 200


@pytest.mark.parametrize(
    ("look", "shadows"),
    [("default", True), pytest.param("original", False, marks=pytest.mark.slow)],
)
def test_reverse_mode_is_finite_everywhere(look, shadows):
    def loss(scene):
        values, _ = colors_and_depth(scene)
        return jnp.sum(values**2)

    gradient = jax.jit(jax.grad(loss))
    for seed in range(4):
        scene = scenes.random_scene(seed, make_look(look, shadows=shadows))
        for leaf in jax.tree.leaves(gradient(jax.tree.map(jnp.asarray, scene))):
            assert bool(jnp.isfinite(leaf).all())


@pytest.mark.parametrize("kind", list(GeomKind))
def test_finite_where_rays_run_along_axes_and_faces(kind):
    """Level cameras and odd sizes put rays exactly on axes, faces and the horizon."""
    size = {GeomKind.PLANE: (0, 0, 1), GeomKind.SPHERE: (0.3, 0, 0)}.get(kind, (0.3, 0.3, 0.3))
    scene = jax.tree.map(
        jnp.asarray, scenes.one_geom(kind, size, (0.0, -2.0, 0.3), target=(0, 0, 0.3))
    )

    def loss(scene):
        frame = render(scene, 9, 9)
        return jnp.sum(frame.r) + jnp.sum(jnp.where(frame.seg >= 0, frame.depth, 0.0))

    value, gradient = jax.jit(jax.value_and_grad(loss))(scene)
    assert bool(jnp.isfinite(value))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))


def test_segmentation_has_no_derivative():
    scene = jax.tree.map(jnp.asarray, scenes.random_scene(0))

    @jax.jit
    def derivative(scene):
        return jax.jvp(lambda s: render(s, 4, 4).seg, (scene,), (zeros_like(scene),))[1]

    tangent = derivative(scene)
    assert tangent.dtype == jax.dtypes.float0
