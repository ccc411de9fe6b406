"""The kernel for NVIDIA GPUs, computed by XLA, against the plain ray-caster."""

from __future__ import annotations

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.distractors import Color, Distractor
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.renderer.kernel import may_see, window_of
from pixelbrax_jax.renderer.view import view_of
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.envs.toy import PARAMS, Ball
from tests.renderer import scenes
from tests.renderer.test_lamps import LAMP
from tests.renderer.test_planes import random_strip

pytestmark = pytest.mark.usefixtures("interpreted")

HEIGHT, WIDTH = 22, 29
"""638 pixels: two blocks of the kernel, and a part of a third. The height is even: of an odd one
the middle row of a level camera looks along the ground, and rounding decides if it meets it."""

NUM_POSES = 5

LOOKS = {
    "default": {},
    "original": {"look": "original"},
    "dmc, shadows": {"look": "dmc", "shadows": True},
    "color": {"distractors": "paper-color"},
    "colors of things": {"distractors": "color-hard", "shadows": True},
    "video over all": {"distractors": "paper-video", "clips": "procedural"},
    "background": {"distractors": "video-hard", "clips": "procedural"},
    "all three": {"distractors": "dcs-hard", "clips": "procedural", "shadows": True},
}


def poses(env, params):
    """States a few frames into an episode, with distractors that have moved."""
    keys = jax.random.split(jax.random.key(0), NUM_POSES)

    def state(key):
        sim = env.reset_sim(key, jnp.uint32(0), params)
        moved = env.chain.advance(sim.distractor_state, key, jnp.int32(3), params)
        turned = sim.physics.xquat + 0.2 * jax.random.normal(key, sim.physics.xquat.shape)
        turned /= jnp.linalg.norm(turned, axis=-1, keepdims=True)
        physics = sim.physics.replace(xquat=turned)
        return sim.replace(distractor_state=moved, physics=physics)

    return jax.jit(jax.vmap(state))(keys)


def images(env, states, params):
    """Images as (N, H, W, 3) int, drawn as a batch."""
    draw = jax.jit(jax.vmap(env.draw, in_axes=(0, None)))
    packed = np.asarray(draw(states, params))
    return packed.view(np.uint8).reshape(*packed.shape, 4)[..., :3].astype(int)


def assert_same_pictures(task, options):
    size = {"height": HEIGHT, "width": WIDTH}
    plain, params = pb.make(task, **size, renderer="fused", **options)
    by_kernel, _ = pb.make(task, **size, renderer="pallas", **options)
    states = poses(plain, params)
    one, other = (images(env, states, params) for env in (plain, by_kernel))
    assert one.std() > 5, "there is something to see"
    assert (np.abs(one - other) <= 1).all(-1).mean() >= 0.999


@pytest.mark.parametrize(
    ("task", "look"),
    [
        ("ant", "default"),
        pytest.param("hopper", "all three", marks=pytest.mark.slow),
        pytest.param("reacher", "dmc, shadows", marks=pytest.mark.slow),
    ],
)
def test_it_draws_what_the_plain_one_draws(task, look):
    assert_same_pictures(task, LOOKS[look])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "look"),
    # Every task in the default look and another one, and every look.
    [(task, "default") for task in BRAX_TASKS]
    + list(zip(BRAX_TASKS, itertools.cycle(sorted(set(LOOKS) - {"default"})), strict=False)),
)
def test_it_draws_every_task_and_every_look(task, look):
    assert_same_pictures(task, LOOKS[look])


@pytest.mark.parametrize("images", ["pixels+depth+segmentation", "segmentation"])
def test_it_draws_all_images_of_an_observation(images):
    """For two cameras, and with a distractor of colors."""
    params = PARAMS.replace(rig=(PARAMS.rig, PARAMS.rig.replace(eye=np.float32([2, -3, 2]))))
    colors = (Color(scale=0.3),) if "pixels" in images else ()
    drawn = []
    for renderer in ("fused", "pallas"):
        env = pb.PixelEnv(
            Ball(), num_cameras=2, height=HEIGHT, width=WIDTH, obs_mode=images,
            renderer=renderer, distractors=colors,
        )  # fmt: skip
        states = poses(env, params)
        drawn.append(jax.jit(jax.vmap(env.draw_obs, in_axes=(0, None)))(states, params))
    one, other = ({"segmentation": d} if "+" not in images else d for d in drawn)
    np.testing.assert_array_equal(one["segmentation"], other["segmentation"])
    assert one["segmentation"].shape == (NUM_POSES, 2, HEIGHT, WIDTH)
    if "+" in images:
        np.testing.assert_allclose(one["depth"], other["depth"], rtol=1e-5)
        bytes_of = [np.asarray(d["pixels"]).view(np.uint8).astype(int) for d in (one, other)]
        assert (np.abs(bytes_of[0] - bytes_of[1]) <= 1).mean() >= 0.999


@pytest.mark.parametrize(
    ("size", "lamps"),
    [
        pytest.param((HEIGHT, WIDTH), 2, marks=pytest.mark.slow),
        pytest.param((HEIGHT, WIDTH), 0, marks=pytest.mark.slow),
        ((1, 1), 0),
        pytest.param((1, 1), 2, marks=pytest.mark.slow),
        pytest.param((3, 300), 0, marks=pytest.mark.slow),
        pytest.param((3, 300), 2, marks=pytest.mark.slow),
    ],
)
def test_depth_and_geoms_are_those_of_the_plain_one(size, lamps):
    """All primitives, planes that end, lamps, and a size that is no multiple of a block."""
    look = make_look("dmc", shadows=True).replace(lamps=(LAMP, LAMP.replace(exponent=3))[:lamps])
    batch = [random_strip(s).replace(look=look) for s in range(3)]
    batch = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(leaf) for leaf in x]), *batch)
    plain, other = (
        jax.jit(jax.vmap(lambda scene, name=name: render(scene, *size, name)))(batch)
        for name in ("fused", "pallas")
    )
    np.testing.assert_array_equal(other.seg, plain.seg)
    np.testing.assert_array_equal(other.ground, plain.ground)
    np.testing.assert_allclose(other.depth, plain.depth, rtol=1e-5)
    for name in "rgb":
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), atol=2e-3)


@pytest.mark.slow
def test_many_geoms():
    """More than a word has bits."""
    count, rng = 70, np.random.default_rng(0)
    one = scenes.one_geom(GeomKind.SPHERE, (0.12, 0, 0), (0.0, -4.0, 0.0))
    repeated = {name: getattr(one.geoms, name) * count for name in ("kind", "link", "name")}
    geoms = one.geoms.replace(
        **repeated,
        material=(0,) * count,
        size=jnp.tile(one.geoms.size, (count, 1)),
    )
    pos = jnp.asarray(rng.uniform(-1, 1, (count, 3)), jnp.float32)
    scene = one.replace(geoms=geoms, pos=pos, xmat=jnp.tile(jnp.eye(3), (count, 1, 1)))
    plain, other = (render(scene, 40, 40, name) for name in ("fused", "pallas"))
    assert len(np.unique(plain.seg)) > 40
    np.testing.assert_array_equal(other.seg, plain.seg)


def test_no_geom_is_left_out_that_is_seen():
    """Random poses, some around the camera and some behind it, and random blocks of pixels."""
    height, width, num_scenes = 24, 32, 100
    rng = np.random.default_rng(0)

    def scene(seed):
        scene = scenes.random_scene(seed)
        eye = scene.camera.pos * jnp.float32(rng.uniform(0.0, 1.0))
        return scene.replace(camera=scene.camera.replace(pos=eye))

    rows = np.sort(rng.integers(0, height, (num_scenes, 2)), axis=1)
    columns = np.sort(rng.integers(0, width, (num_scenes, 2)), axis=1)
    batch = jax.tree.map(lambda *x: jnp.stack(x), *[scene(s) for s in range(num_scenes)])

    @jax.jit
    @jax.vmap
    def look(scene, rows, columns):
        view = view_of(scene, height)
        seen = may_see(view, window_of(view, tuple(rows), tuple(columns), height, width))
        by_rows = may_see(view, window_of(view, tuple(rows), None, height, width))
        alone, flags = [], []
        for g in range(1, len(scene.geoms.kind)):
            geoms = scene.geoms.replace(
                **{k: (getattr(scene.geoms, k)[g],) for k in ("kind", "link", "name")},
                material=(0,),
                size=scene.geoms.size[g : g + 1],
            )
            one = scene.replace(geoms=geoms, pos=scene.pos[g : g + 1], xmat=scene.xmat[g : g + 1])
            alone.append(render(one, height, width, "fused").seg == 0)
            flags.append(jnp.stack([seen(g), by_rows(g)]))
        return jnp.stack(alone), jnp.stack(flags)

    alone, flags = map(np.asarray, look(batch, rows, columns))
    left_out = 0
    for scene_alone, scene_flags, (top, bottom), (left, right) in zip(
        alone, flags, rows, columns, strict=True
    ):
        of_rows = scene_alone[:, top : bottom + 1]
        window = of_rows[:, :, left : right + 1].any((1, 2))
        assert scene_flags[window, 0].all()
        assert scene_flags[of_rows.any((1, 2)), 1].all()
        left_out += (~scene_flags[~window, 0]).sum()
    # Most of those that are not seen.
    assert left_out > 0.6 * num_scenes


def test_a_band_is_a_part_of_the_picture():
    scene = scenes.random_scene(3)
    draw = jax.jit(partial(render, renderer="pallas"), static_argnums=(1, 2))
    whole = draw(scene, HEIGHT, WIDTH)
    band = render(scene, HEIGHT, WIDTH, "pallas", first_row=jnp.int32(4), num_rows=7)
    np.testing.assert_array_equal(band.seg, whole.seg[4:11])
    np.testing.assert_allclose(band.r, whole.r[4:11], atol=1e-4)


def test_it_has_the_derivative_of_the_plain_one():
    scene = scenes.random_scene(1)

    def brightness(light, renderer):
        look = scene.look.replace(light=light)
        return render(scene.replace(look=look), HEIGHT, WIDTH, renderer).r.mean()

    one, other = (jax.grad(brightness)(scene.look.light, r) for r in ("fused", "pallas"))
    assert np.abs(one).max() > 1e-4
    np.testing.assert_allclose(other, one, rtol=1e-5)


@pytest.mark.slow
def test_rewards_may_be_differentiated_beside_an_image():
    size = {"height": HEIGHT, "width": WIDTH}
    env, params = pb.make("inverted_pendulum", renderer="pallas", **size)
    state, _ = env.reset(jax.random.key(0), params)

    def position(action):
        return env.step(state, action, params)[0].sim.physics.obs[0]

    assert float(jax.grad(position)(jnp.zeros(1))[0]) != 0.0


class Mirrored(Distractor):
    """Not pixel by pixel: a kernel cannot do it."""

    kind, stream = "mirrored", 7

    def __hash__(self):
        return 7

    def __eq__(self, other):
        return isinstance(other, Mirrored)

    def reset(self, key, params):
        return key

    def change_frame(self, state, frame, backdrop):
        return jax.tree.map(lambda plane: plane[:, ::-1], frame)


def test_a_distractor_of_whole_images_changes_what_the_kernel_has_drawn():
    assert_same_pictures("hopper", {"distractors": (Mirrored(), Color(dynamics="static"))})
