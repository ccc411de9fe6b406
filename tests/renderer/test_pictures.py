"""Facts of analytic geometry, and the fast ray-caster against the plain one."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.renderer import shading
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.types import FAR
from tests.renderer import scenes

SIZE = 48


@pytest.fixture(scope="module")
def draw():
    """``render`` of both kinds, compiled once for all scenes of one structure."""
    return jax.jit(render, static_argnums=(1, 2, 3))


def rgb(frame) -> np.ndarray:
    return np.stack([frame.r, frame.g, frame.b], axis=-1)


class TestAnalyticFacts:
    @pytest.mark.slow
    def test_sphere_depth_and_silhouette(self, draw):
        radius, distance, fovy, size = 0.5, 3.0, 40.0, 65
        scene = scenes.one_geom(GeomKind.SPHERE, (radius, 0, 0), (0.0, -distance, 0.0), fovy=fovy)
        frame = draw(scene, size, size, "fused")
        middle = size // 2
        assert frame.depth[middle, middle] == pytest.approx(distance - radius, rel=1e-5)
        # The tangent cone's half angle is asin(r / d); its cut with the image plane is a circle.
        cone = np.tan(np.arcsin(radius / distance)) / np.tan(np.deg2rad(fovy / 2)) * size / 2
        assert int((frame.seg == 0).sum()) == pytest.approx(np.pi * cone**2, rel=0.02)

    @pytest.mark.slow
    def test_box_covers_a_rectangle(self, draw):
        scene = scenes.one_geom(GeomKind.BOX, (0.5, 0.2, 0.25), (0.0, -2.2, 0.0), fovy=60.0)
        seg = np.asarray(draw(scene, 60, 60, "fused").seg) == 0
        # Front face at depth 2, half extents 0.5 x 0.25: 30 / tan(30 deg) pixels a unit slope.
        scale = 30 / np.tan(np.deg2rad(30))
        rows, columns = seg.any(axis=1).sum(), seg.any(axis=0).sum()
        assert columns == pytest.approx(2 * 0.5 / 2 * scale, abs=1)
        assert rows == pytest.approx(2 * 0.25 / 2 * scale, abs=1)
        assert seg.sum() == rows * columns

    @pytest.mark.parametrize("renderer", ["fused", "reference"])
    def test_plane_depth_is_linear_in_the_inverse_row(self, renderer):
        scene = scenes.one_geom(GeomKind.PLANE, (0, 0, 1), (0.0, 0.0, 2.0), target=(0.0, 1.0, 2.0))
        frame = render(scene, 40, 8, renderer)
        row = np.arange(40)
        slope = (row + 0.5 - 20) / 20 * np.tan(np.deg2rad(20))
        below = slope > 0
        expected = np.tile((2.0 / slope[below])[:, None], (1, 8))
        np.testing.assert_allclose(frame.depth[below], expected, rtol=1e-4)
        assert (np.asarray(frame.seg)[~below] == -1).all()
        assert (np.asarray(frame.depth)[~below] == FAR).all()

    @pytest.mark.slow
    def test_frames_are_upright_and_not_mirrored(self, draw):
        # Seen from -y with z up, +x is right.
        for pos, half in (((0.5, 0, 0), np.s_[:, 24:]), ((0, 0, 0.5), np.s_[:24, :])):
            scene = scenes.one_geom(GeomKind.SPHERE, (0.1, 0, 0), (0.0, -3.0, 0.0), pos=pos)
            seg = np.asarray(draw(scene, SIZE, SIZE, "fused").seg) == 0
            assert seg.sum() > 10
            assert seg[half].sum() == seg.sum()

    def test_ray_along_a_capsule_or_cylinder(self, draw):
        for kind, top in ((GeomKind.CAPSULE, 0.6), (GeomKind.CYLINDER, 0.5), (GeomKind.BOX, 0.5)):
            size = (0.1, 0.1, 0.5) if kind == GeomKind.BOX else (0.1, 0.5, 0.0)
            scene = scenes.one_geom(kind, size, (0.0, 0.0, 0.0))
            above = scene.camera.replace(pos=jnp.array([0.0, 0.0, 2.0]), xmat=jnp.eye(3))
            frame = draw(scene.replace(camera=above), 33, 33, "fused")
            assert frame.depth[16, 16] == pytest.approx(2.0 - top, rel=1e-4)

    def test_non_square_pictures_keep_the_vertical_field_of_view(self, draw):
        scene = scenes.random_scene(0)
        square = draw(scene, SIZE, SIZE, "fused")
        wide = draw(scene, SIZE, 2 * SIZE, "fused")
        np.testing.assert_array_equal(wide.seg[:, SIZE // 2 : -SIZE // 2], square.seg)

    def test_one_pixel(self):
        frame = render(scenes.random_scene(0), 1, 1)
        assert frame.r.shape == (1, 1)


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("look", ["default", "original"])
def test_fused_draws_what_the_reference_draws(draw, look, shadows):
    look = make_look(look, shadows=shadows)
    for seed in range(6):
        scene = scenes.random_scene(seed, look)
        pair = (draw(scene, SIZE, SIZE, name) for name in ("fused", "reference"))
        scenes.assert_alike(*pair, colors=0.004)


def test_bands_of_rows_make_up_the_picture(draw):
    scene = scenes.random_scene(3)
    whole = draw(scene, SIZE, SIZE, "fused")
    for renderer in ("fused", "reference"):
        band = render(scene, SIZE, SIZE, renderer, first_row=11, num_rows=7)
        np.testing.assert_array_equal(band.seg, whole.seg[11:18])


def test_shadow_darkens_the_ground_and_nothing_else(draw):
    scene = scenes.random_scene(1)
    lit = draw(scene, SIZE, SIZE, "fused")
    shaded = draw(
        scene.replace(look=dataclasses.replace(scene.look, shadows=True)), SIZE, SIZE, "fused"
    )
    darker = rgb(shaded).sum(-1) < rgb(lit).sum(-1) - 1e-3
    # Programs differ in rounding.
    assert (rgb(shaded) <= rgb(lit) + 1e-5).all()
    assert (darker & (np.asarray(lit.seg) == 0)).mean() > 0.01
    sky = np.asarray(lit.seg) == -1
    np.testing.assert_array_equal(rgb(shaded)[sky], rgb(lit)[sky])


class TestGround:
    @pytest.mark.parametrize(
        ("pattern", "mark"),
        [("checker", None), ("checker", 0.01), ("checker", 0.2), ("grid", None)],
    )
    def test_share_is_the_mean_over_the_window(self, pattern, mark):
        rng = np.random.default_rng(0)
        look = make_look("default").replace(ground=pattern, ground_mark=mark)
        x, y = rng.uniform(-3, 3, (2, 20))
        width_x, width_y = rng.uniform(0.05, 3, (2, 20))
        share = shading.second_color_fraction(look, x, y, width_x, width_y)
        steps = (np.arange(400) + 0.5) / 400 - 0.5
        for k in range(20):
            px = (x[k] + width_x[k] * steps)[:, None]
            py = (y[k] + width_y[k] * steps)[None, :]
            if pattern == "checker":
                second = (np.floor(px) + np.floor(py)) % 2 == 1
                for along in (px, py) if mark else ():
                    second |= np.abs(along - 2 * np.round(along / 2)) < mark
            else:
                second = (px % 1 < shading.LINE_WIDTH) | (py % 1 < shading.LINE_WIDTH)
            assert share[k] == pytest.approx(second.mean(), abs=0.01)

    @pytest.mark.parametrize("look", ["default", "original"])
    def test_ground_does_not_flicker_under_motion(self, draw, look):
        """A point-sampled pattern jumps between frames; its mean over a pixel cannot."""
        scene = scenes.one_geom(GeomKind.PLANE, (0, 0, 1), (0.0, -2.1, 0.8), target=(0, 0, 0.6))
        scene = scene.replace(look=make_look(look))
        step, frames = 0.002, []
        for k in range(40):
            camera = scene.camera.replace(pos=scene.camera.pos + jnp.array([k * step, 0.0, 0.0]))
            frames.append(rgb(draw(scene.replace(camera=camera), SIZE, SIZE, "fused")))
        frames = np.stack(frames)
        change = np.abs(np.diff(frames, axis=0)).max(axis=(-1, -2)).max(axis=0)
        # A change is at most contrast x motion in pixels x 2 edges; nearest rows move most.
        pixel = 2 * np.tan(np.deg2rad(20)) / SIZE
        contrast = np.ptp(frames)
        depth = np.asarray(draw(scene, SIZE, SIZE, "fused").depth).min(axis=1)
        motion = step / (depth * pixel)
        seen = depth < FAR
        assert (change[seen] <= 2.2 * contrast * motion[seen] + 2e-3).all()
        # Far away the pattern fades to its mean.
        horizon = np.argmax(seen) + 1
        assert np.ptp(frames[:, horizon], axis=(0, 1)).max() < 0.03

    def test_pattern_is_anchored_to_the_world(self, draw):
        scene = scenes.one_geom(GeomKind.PLANE, (0, 0, 1), (0.0, -2.0, 1.0), target=(0, 0, 0))
        period = 2 * float(scene.look.ground_pitch)
        images = [
            rgb(
                draw(
                    scene.replace(
                        camera=scene.camera.replace(
                            pos=scene.camera.pos + jnp.array([shift, 0.0, 0.0])
                        )
                    ),
                    SIZE,
                    SIZE,
                    "fused",
                )
            )
            for shift in (0.0, period / 2, period, 100 * period)
        ]
        np.testing.assert_allclose(images[2], images[0], atol=2 / 255)
        np.testing.assert_allclose(images[3], images[0], atol=4 / 255)
        assert np.abs(images[1] - images[0]).max() > 0.1


def test_bad_sizes_and_names():
    scene = scenes.random_scene(0)
    with pytest.raises(ValueError, match="height must be at least 1 pixel, got 0"):
        render(scene, 0, 4)
    with pytest.raises(
        ValueError, match="unknown renderer: 'fast'; allowed: auto, fused, pallas, "
    ):
        render(scene, 4, 4, "fast")
