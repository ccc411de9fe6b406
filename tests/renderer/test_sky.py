"""The sky's texture: a cube map, looked up by a ray's direction in the world."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look, make_rig
from pixelbrax_jax.physics.mujoco.lighting import detailed, read_look
from pixelbrax_jax.physics.mujoco.sky import sky_texture
from pixelbrax_jax.renderer.base import draw, pack, render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.spatial import look_at
from tests.renderer.scenes import from_above, geoms_of, scene_of
from tests.renderer.test_planes import RENDERERS

SIZE = 12
FOVY = 130.0
FAR_AWAY = (GeomKind.SPHERE, (0.1, 0, 0), (0, 0, 90.0))
"""Too small to be seen."""
VIEWS = [(1.0, 0.5, 0.3), (-1.0, -0.4, 0.8), (0.1, 1.0, -0.9), (-0.2, -1.0, 0.1), (0.3, 0.4, -1.0)]


def texture_of(size: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.2, 0.4, (6, size, size, 3)).astype(np.float32)


def texel(texture: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Look a direction up as the OpenGL specification says; the cube's y is the world's z."""
    s, t, r = ray[0], ray[2], -ray[1]
    major = max(abs(s), abs(t), abs(r))
    if major == abs(s):
        face, across, down = (0, -r, -t) if s > 0 else (1, r, -t)
    elif major == abs(t):
        face, across, down = (2, s, r) if t > 0 else (3, s, -r)
    else:
        face, across, down = (4, s, -t) if r > 0 else (5, -s, -t)
    size = texture.shape[1]
    x, y = (0.5 * size * (along / major + 1.0) - 0.5 for along in (across, down))
    value = np.zeros(3)
    for row in (np.floor(y), np.floor(y) + 1):
        for column in (np.floor(x), np.floor(x) + 1):
            weight = (1 - abs(row - y)) * (1 - abs(column - x))
            i, j = (int(np.clip(place, 0, size - 1)) for place in (row, column))
            value += weight * texture[face, i, j]
    return value


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("renderer", [*RENDERERS, "pallas"])
def test_directions_see_the_texels_of_opengls_cube_map(renderer):
    texture = texture_of(4)
    look = make_look("dmc").replace(sky_texture=jnp.asarray(texture))

    @jax.jit
    def seen(xmat):
        camera = from_above(0.0, FOVY).replace(xmat=xmat)
        frame = render(scene_of(FAR_AWAY, look=look, camera=camera), SIZE, SIZE, renderer)
        return jnp.stack([frame.r, frame.g, frame.b], axis=-1), frame.seg

    step = 2 * np.tan(np.deg2rad(FOVY / 2)) / SIZE
    place_of = (np.arange(SIZE) - 0.5 * (SIZE - 1)) * step
    for view in VIEWS:
        xmat = np.asarray(look_at(jnp.zeros(3), jnp.array(view), jnp.array([0.1, 0.0, 1.0])))
        image, seg = seen(xmat)
        for row in range(SIZE):
            for column in range(SIZE):
                if seg[row, column] >= 0:
                    continue
                ray = xmat @ np.array([place_of[column], -place_of[row], -1.0])
                rise = ray[2] / np.linalg.norm(ray)
                other = look.sky[1] if rise > 0 else look.sky[2]
                color = look.sky[0] + abs(rise) * (other - look.sky[0]) + texel(texture, ray)
                np.testing.assert_allclose(
                    image[row, column], np.clip(color, 0, 1), atol=2e-3, err_msg=f"{view}"
                )


@pytest.mark.usefixtures("interpreted")
def test_a_kernel_that_changes_colors_sees_the_texture():
    look = make_look("dmc").replace(sky_texture=jnp.asarray(texture_of(4)))
    scene = scene_of(FAR_AWAY, look=look, camera=from_above(0.0, FOVY))
    backdrop = jnp.linspace(0.0, 0.3, SIZE * SIZE).reshape(SIZE, SIZE)

    def change(frame, rows):
        return frame.replace(r=jnp.minimum(frame.r + backdrop[rows], 1.0))

    one, other = (draw(scene, SIZE, SIZE, name, change) for name in ("fused", "pallas"))
    levels = [np.asarray(image).view(np.uint8).astype(int) for image in (one, other)]
    assert levels[0].std() > 5
    assert np.abs(levels[0] - levels[1]).max() <= 1


def sky_model(size: int) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <asset><texture type="skybox" builtin="gradient" rgb1=".4 .6 .8" rgb2="0 0 0"
        width="{size}" height="{size}" mark="random" random="0.2"/></asset>
      <worldbody><geom size="1"/></worldbody>
    </mujoco>""")


def test_a_texel_is_the_mean_of_what_a_pixel_covers():
    model = sky_model(16)
    look = read_look(model)
    pixels = model.tex_data.reshape(6, 16, 16, 3) / 255.0
    fine, coarse = (sky_texture(model, look.sky, pixel) for pixel in (2 / 16, 4 / 16))
    assert coarse.shape == (6, 8, 8, 3)
    # Without the gradient, of which each texel has its own.
    gradient = pixels - fine
    halves = [x.reshape(6, 8, 2, 8, 2, 3).mean((2, 4)) for x in (pixels, gradient)]
    np.testing.assert_allclose(coarse + halves[1], halves[0], atol=0.01)
    assert np.abs(fine).max() > 0.3
    # Between two levels, the values are between theirs.
    between = sky_texture(model, look.sky, 2**0.5 * 2 / 16)
    assert between.shape == fine.shape
    assert between.std() < 0.9 * fine.std()
    assert between.std() > coarse.std()


def test_no_sky_and_huge_pixels():
    bare = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    )
    assert detailed(bare, read_look(bare), 0.1).sky_texture is None
    model = sky_model(16)
    assert detailed(model, read_look(model), 100.0).sky_texture.shape == (6, 4, 4, 3)


def test_cameras_that_do_not_turn_look_the_texture_up_once():
    """A batch of links has one orientation of the camera, and one image of the sky."""
    look = make_look("dmc").replace(sky_texture=texture_of(4))
    geoms = geoms_of([GeomKind.SPHERE], [(0.1, 0.0, 0.0)])
    rig = make_rig((0, -3, 1), (0, 0, 1), 45.0, link=0, track=(1.0, 1.0, 1.0))

    def red(xpos):
        xquat = jnp.array([[1.0, 0.0, 0.0, 0.0]])
        return render(place(geoms, rig, look, xpos, xquat), 5, 5, "fused").r

    program = jax.jit(jax.vmap(red)).lower(jnp.zeros((7, 1, 3))).as_text()
    lookups = [line for line in program.splitlines() if "stablehlo.gather" in line]
    assert sum("tensor<25x3xf32>" in line for line in lookups) == 4
    assert "7x25x3x" not in program


def test_cameras_that_turn_look_it_up_apart_from_other_colors():
    """In the loop over pixels XLA for CPUs takes several times as long."""
    look = make_look("dmc").replace(sky_texture=texture_of(4))
    geoms = geoms_of([GeomKind.SPHERE], [(0.1, 0.0, 0.0)])
    rig = make_rig((0, -3, 1), (0, 0, 1), 45.0)

    def packed(eye):
        turned, xquat = rig.replace(eye=eye), jnp.array([[1.0, 0.0, 0.0, 0.0]])
        frame = render(place(geoms, turned, look, jnp.zeros((1, 3)), xquat), 5, 5, "fused")
        return pack(frame)

    program = jax.jit(jax.vmap(packed)).lower(jnp.ones((7, 3))).compile().as_text()
    (lookup,) = (part for part in program.split("\n\n") if " gather(" in part)
    (root,) = (line for line in lookup.splitlines() if "ROOT" in line)
    assert "f32[7,25,3]" in root


@pytest.mark.slow
def test_gradients_with_a_texture_are_finite():
    look = make_look("dmc").replace(sky_texture=jnp.asarray(texture_of(4)))
    scene = scene_of(FAR_AWAY, look=look, camera=from_above(0.0, FOVY))
    gradient = jax.grad(lambda s: jnp.sum(render(s, 6, 6).g))(jax.tree.map(jnp.asarray, scene))
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(gradient))
    assert float(jnp.abs(gradient.look.sky_texture).sum()) > 1.0
