"""The kernel for NVIDIA GPUs, computed by XLA, against the plain ray-caster; and its choice."""

from __future__ import annotations

import re
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.distractors import Color, Distractor
from pixelbrax_jax.renderer import base, kernel
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.renderer.culling import may_see, window_of
from pixelbrax_jax.renderer.pixels import view_of
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.renderer import scenes
from tests.renderer.test_lamps import LAMP
from tests.renderer.test_planes import random_strip

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
    by_kernel, _ = pb.make(task, **size, renderer="pallas-interpret", **options)
    states = poses(plain, params)
    one, other = (images(env, states, params) for env in (plain, by_kernel))
    assert one.std() > 5, "there is something to see"
    assert (np.abs(one - other) <= 1).all(-1).mean() >= 0.999


@pytest.mark.parametrize(
    ("task", "look"),
    [("ant", "default"), ("hopper", "all three"), ("reacher", "dmc, shadows"), ("hopper", "color")],
)
def test_it_draws_what_the_plain_one_draws(task, look):
    assert_same_pictures(task, LOOKS[look])


@pytest.mark.slow
@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("task", BRAX_TASKS)
def test_it_draws_every_task_in_every_look(task, look):
    assert_same_pictures(task, LOOKS[look])


@pytest.mark.parametrize("lamps", [0, 2])
@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (1, 1), (3, 300)])
def test_depth_and_geoms_are_those_of_the_plain_one(size, lamps):
    """All primitives, planes that end, lamps, and a size that is no multiple of a block."""
    look = make_look("dmc", shadows=True).replace(lamps=(LAMP, LAMP.replace(exponent=3))[:lamps])
    batch = [random_strip(s).replace(look=look) for s in range(3)]
    batch = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(leaf) for leaf in x]), *batch)
    plain, other = (
        jax.jit(jax.vmap(lambda scene, name=name: render(scene, *size, name)))(batch)
        for name in ("fused", "pallas-interpret")
    )
    np.testing.assert_array_equal(other.seg, plain.seg)
    np.testing.assert_array_equal(other.ground, plain.ground)
    np.testing.assert_allclose(other.depth, plain.depth, rtol=1e-5)
    for name in "rgb":
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), atol=2e-3)


def test_every_primitive():
    scene = scenes.random_scene(2)
    plain, other = (
        jax.jit(render, static_argnums=(1, 2, 3))(scene, HEIGHT, WIDTH, name)
        for name in ("fused", "pallas-interpret")
    )
    assert len(np.unique(plain.seg)) >= 5
    np.testing.assert_array_equal(other.seg, plain.seg)
    np.testing.assert_allclose(other.depth, plain.depth, rtol=1e-5)


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
    plain, other = (render(scene, 40, 40, name) for name in ("fused", "pallas-interpret"))
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
            rank = view.geom.index(g)
            flags.append(jnp.stack([seen(rank), by_rows(rank)]))
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
    draw = jax.jit(partial(render, renderer="pallas-interpret"), static_argnums=(1, 2))
    whole = draw(scene, HEIGHT, WIDTH)
    band = render(scene, HEIGHT, WIDTH, "pallas-interpret", first_row=jnp.int32(4), num_rows=7)
    np.testing.assert_array_equal(band.seg, whole.seg[4:11])
    np.testing.assert_allclose(band.r, whole.r[4:11], atol=1e-4)


def test_it_has_the_derivative_of_the_plain_one():
    scene = scenes.random_scene(1)

    def brightness(light, renderer):
        look = scene.look.replace(light=light)
        return render(scene.replace(look=look), HEIGHT, WIDTH, renderer).r.mean()

    one, other = (jax.grad(brightness)(scene.look.light, r) for r in ("fused", "pallas-interpret"))
    assert np.abs(one).max() > 1e-4
    np.testing.assert_allclose(other, one, rtol=1e-5)


def test_rewards_may_be_differentiated_beside_an_image():
    size = {"height": HEIGHT, "width": WIDTH}
    env, params = pb.make("inverted_pendulum", renderer="pallas-interpret", **size)
    state, _ = env.reset(jax.random.key(0), params)

    def position(action):
        return env.step(state, action, params)[0].sim.physics.obs[0]

    assert float(jax.grad(position)(jnp.zeros(1))[0]) != 0.0


class Mirrored(Distractor):
    """Not by pixel: what it does needs the rows."""

    kind, stream = "mirrored", 7

    def __hash__(self):
        return 7

    def __eq__(self, other):
        return isinstance(other, Mirrored)

    def reset(self, key, params):
        return key

    def change_frame(self, state, frame, backdrop):
        return jax.tree.map(lambda plane: plane[:, ::-1], frame)


def test_a_distractor_that_is_not_by_pixel_changes_the_whole_image():
    assert_same_pictures("hopper", {"distractors": (Mirrored(), Color(dynamics="static"))})


class TestTheChoice:
    def test_pallas_needs_an_nvidia_gpu(self):
        if jax.default_backend() == "gpu":
            pytest.skip("there is one")
        for make in (
            lambda: pb.make("ant", renderer="pallas"),
            lambda: render(scenes.random_scene(0), 4, 4, "pallas"),
        ):
            with pytest.raises(ValueError, match="is a kernel for NVIDIA GPUs") as error:
                make()
            for alternative in ("'auto'", "'fused'", "'pallas-interpret'"):
                assert alternative in str(error.value)

    def test_a_nearly_right_name(self):
        with pytest.raises(ValueError, match="Did you mean 'pallas-interpret'"):
            pb.make("ant", renderer="pallas_interpret")

    def test_a_card_that_is_too_old(self, monkeypatch):
        from jax.experimental.pallas import triton

        class Card:
            device_kind, compute_capability = "Tesla V100", "7.0"
            client = SimpleNamespace(platform_version="cuda 12.9")

        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(jax, "devices", lambda: [Card])
        monkeypatch.delattr(triton, "get_gpu_info", raising=False)
        assert "Tesla V100 has compute capability 7.0" in kernel.obstacle()
        assert kernel.auto_renderer()[0] == "fused"
        with pytest.raises(ValueError, match=r"compute capability 7\.0"):
            base.check_renderer("pallas")
        Card.compute_capability = "9.0"
        assert kernel.obstacle() is None
        assert kernel.auto_renderer() == ("pallas", "by one kernel, on Tesla V100")
        Card.client.platform_version = "rocm 7"
        assert "ROCm" in kernel.obstacle()
        # Newer releases of JAX describe such a card too.
        info = SimpleNamespace(compute_capability=0)
        monkeypatch.setattr(triton, "get_gpu_info", lambda: info, raising=False)
        assert "ROCm" in kernel.obstacle()
        Card.client.platform_version = "cuda 12.9"
        info.compute_capability = 75
        assert kernel.obstacle() == "the card has compute capability 7.5, and the kernel needs 8.0"

    @pytest.mark.parametrize("renderer", ["auto", "fused"])
    def test_a_batch_is_one_kernel_in_a_program_for_cuda(self, monkeypatch, renderer):
        monkeypatch.setattr(kernel, "obstacle", lambda: None)
        env, params = pb.make("hopper", height=HEIGHT, width=WIDTH, renderer=renderer)
        states = poses(env, params)
        draw = jax.jit(jax.vmap(env.draw, in_axes=(0, None)))
        with on_h100():
            text = draw.trace(states, params).lower(lowering_platforms=("cuda",)).as_text()
        kernels = re.findall(r"xla\.gpu\.triton.*?grid_x = (\d+).*?grid_y = (\d+)", text, re.S)
        assert kernels == ([("3", str(NUM_POSES))] if renderer == "auto" else [])
        # No loop over environments, nor over bands.
        assert ("stablehlo.while" in text) == (renderer == "fused")

    def test_a_program_for_a_cpu_is_that_of_the_plain_one(self, monkeypatch):
        size = {"height": HEIGHT, "width": WIDTH}
        texts = []
        for renderer, why in (("auto", None), ("auto", "no card"), ("fused", None)):
            monkeypatch.setattr(kernel, "obstacle", lambda why=why: why)
            env, params = pb.make("hopper", renderer=renderer, **size)
            jax.clear_caches()
            states = poses(env, params)
            texts.append(jax.jit(env.draw).lower(jax.tree.map(lambda x: x[0], states), params))
        texts = [text.compile().as_text() for text in texts]
        assert "triton" not in texts[0]
        one, *others = (re.sub(r", metadata=\{[^}]*\}", "", text) for text in texts)
        assert all(other.count(" fusion(") == one.count(" fusion(") for other in others)


def on_h100():
    """The context in which programs are lowered for an H100."""
    device = jax.sharding.AbstractDevice("NVIDIA H100", 132, "gpu")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    return jax.sharding.use_abstract_mesh(mesh)
