"""Which renderer ``"auto"`` stands for, and the check that the kernel must pass."""

from __future__ import annotations

import re
import warnings
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.renderer import base, choice, fused, kernel
from tests.envs.toy import PARAMS, Ball
from tests.renderer import scenes

HEIGHT, WIDTH, NUM_ENVS = 22, 29, 5


def test_the_kernel_passes_its_check(interpreted):
    check = choice.compare(kernel.render)
    assert check.passed, check.text
    assert check.text == "it renders 1920 pixels like renderer='fused'"


@pytest.mark.slow
def test_the_images_of_the_check_are_far_from_rounding():
    """Everything moved by more than rounding does: the images are the same, in all their parts."""

    def moved(scene, *band, by):
        return fused.render(scene.replace(pos=scene.pos + by), *band)

    assert all(choice.compare(partial(moved, by=by)).passed for by in (-5e-5, 5e-5))
    assert not choice.compare(partial(moved, by=0.05)).passed


def test_every_kind_of_geom_the_sky_shadows_and_a_reflection_are_in_the_check():
    def drawn(eye, **look):
        scene = choice._scene(eye)
        scene = scene.replace(look=scene.look.replace(**look))
        return fused.render(scene, choice._HEIGHT, choice._WIDTH, 0, choice._HEIGHT)

    whole, *others = (
        jax.jit(jax.vmap(partial(drawn, **look)))(np.array(choice._EYES))
        for look in ({}, {"shadows": False}, {"reflectance": None})
    )
    for k in range(len(choice._EYES)):
        assert np.unique(whole.seg[k]).tolist() == list(range(-1, len(pb.GeomKind)))
        for other in others:
            assert (np.abs(whole.r[k] - other.r[k]) > 0.05).any()


@pytest.mark.parametrize(
    ("plane", "value", "told"),
    [
        ("r", 2.0, "1 of 1920 pixels differ from those of renderer='fused', colors by up to"),
        pytest.param("g", float("nan"), "1 of 1920 pixels", marks=pytest.mark.slow),
        pytest.param("depth", 0.5, "depth by up to", marks=pytest.mark.slow),
        pytest.param("seg", 77, "1 of 1920 pixels", marks=pytest.mark.slow),
    ],
)
def test_one_wrong_pixel_is_refused(plane, value, told):
    def wrong(scene, *band):
        frame = fused.render(scene, *band)
        # Of one of the two images.
        which = scene.camera.pos[0] > 0
        right = getattr(frame, plane)
        return frame.replace(**{plane: jnp.where(which, right.at[7, 11].set(value), right)})

    check = choice.compare(wrong)
    assert not check.passed
    assert told in check.text


@pytest.fixture
def card(monkeypatch):
    """JAX says that it computes on an NVIDIA GPU."""
    from jax.experimental.pallas import triton

    client = SimpleNamespace(platform_version="cuda 12.9")
    card = SimpleNamespace(device_kind="NVIDIA H100", compute_capability="9.0", client=client)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "devices", lambda: [card])
    monkeypatch.delattr(triton, "get_gpu_info", raising=False)
    check = choice.kernel_check
    check.cache_clear()
    yield card
    check.cache_clear()


def fails(*args, **kwargs):
    raise RuntimeError("ptxas died\nat line 3")


def test_a_kernel_that_fails_is_told_of_once(card, monkeypatch):
    monkeypatch.setattr(kernel, "render", fails)
    with pytest.warns(RuntimeWarning, match="Please report this line") as caught:
        env = pb.PixelEnv(Ball(), height=8, width=8)
    (warning,) = caught
    said = str(warning.message)
    for part in ("RuntimeError: ptxas died", "NVIDIA H100", f"jax {jax.__version__}", "cuda 12.9"):
        assert part in said
    assert "pixelbrax doctor" in said
    assert "line 3" not in said
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        state, _ = env.reset(jax.random.key(0), PARAMS)
        pb.PixelEnv(Ball(), height=9, width=9)
        # Also where the first use is in a program of the user's.
        jax.jit(lambda scene: base.render(scene, 4, 4))(scenes.random_scene(0))
    assert state.frames.any()
    why = "it fails with RuntimeError: ptxas died"
    assert choice.why_no_kernel() == why
    assert choice.auto_renderer() == ("fused", f"not by one kernel: {why}")


def test_the_kernel_is_checked_once_and_then_drawn_with(card, monkeypatch):
    calls = []

    def counted(*args):
        calls.append(args)
        return fused.render(*args)

    monkeypatch.setattr(kernel, "render", counted)
    # Within a trace, too, the check is a program of its own.
    program = jax.make_jaxpr(lambda x: x if choice.why_no_kernel() is None else -x)(1.0)
    assert not program.eqns
    assert choice.why_no_kernel() is None
    assert len(calls) == 1
    name, why = choice.auto_renderer()
    assert name == "pallas"
    assert why.startswith("by one kernel, on NVIDIA H100; it renders 1920 pixels like")
    # Asked for by name, it is not checked.
    monkeypatch.setattr(choice, "kernel_check", fails)
    assert base.check_renderer("pallas") == "pallas"
    assert base.check_renderer("auto") == "auto"


def test_a_card_that_cannot_have_it(card, monkeypatch):
    from jax.experimental.pallas import triton

    card.compute_capability = "7.0"
    assert "NVIDIA H100 has compute capability 7.0" in choice.why_no_kernel()
    with pytest.raises(ValueError, match=r"compute capability 7\.0"):
        base.check_renderer("pallas")
    card.compute_capability = "9.0"
    assert choice.why_unsupported() is None
    # Newer releases of JAX describe such a card too.
    info = SimpleNamespace(compute_capability=75)
    monkeypatch.setattr(triton, "get_gpu_info", lambda: info, raising=False)
    why = "the card has compute capability 7.5, and the kernel needs 8.0"
    assert choice.why_unsupported() == why
    card.client.platform_version = "rocm 7"
    assert "ROCm" in choice.why_unsupported()


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="there is an NVIDIA GPU")
def test_pallas_needs_an_nvidia_gpu():
    for make in (
        lambda: pb.make("ant", renderer="pallas"),
        lambda: base.render(scenes.random_scene(0), 4, 4, "pallas"),
    ):
        with pytest.raises(ValueError, match=r"is a kernel for NVIDIA GPUs.*'auto'.*'fused'"):
            make()


def test_a_nearly_right_name():
    with pytest.raises(ValueError, match="Did you mean 'pallas'"):
        pb.make("ant", renderer="palas")


def states_of(env, params):
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    reset = jax.vmap(lambda key: env.reset_sim(key, jnp.uint32(0), params))
    return jax.eval_shape(reset, keys)


@pytest.mark.parametrize("renderer", ["auto", "fused"])
def test_a_batch_is_one_kernel_in_a_program_for_cuda(monkeypatch, renderer):
    monkeypatch.setattr(choice, "why_no_kernel", lambda: None)
    env, params = pb.make("hopper", height=HEIGHT, width=WIDTH, renderer=renderer)
    states = states_of(env, params)
    draw = jax.jit(jax.vmap(env.draw, in_axes=(0, None)))
    with on_h100():
        text = draw.trace(states, params).lower(lowering_platforms=("cuda",)).as_text()
    kernels = re.findall(r"xla\.gpu\.triton.*?grid_x = (\d+).*?grid_y = (\d+)", text, re.S)
    assert kernels == ([("3", str(NUM_ENVS))] if renderer == "auto" else [])
    # No loop over environments, nor over bands.
    assert ("stablehlo.while" in text) == (renderer == "fused")


@pytest.mark.slow
def test_a_program_for_a_cpu_is_that_of_the_plain_one(monkeypatch):
    texts = []
    for renderer, why in (("auto", None), ("auto", "no card"), ("fused", None)):
        monkeypatch.setattr(choice, "why_no_kernel", lambda why=why: why)
        env, params = pb.make("hopper", renderer=renderer, height=HEIGHT, width=WIDTH)
        jax.clear_caches()
        state = jax.tree.map(lambda x: x.update(shape=x.shape[1:]), states_of(env, params))
        texts.append(jax.jit(env.draw).lower(state, params).compile().as_text())
    assert "triton" not in texts[0]
    assert len({text.count(" fusion(") for text in texts}) == 1


def on_h100():
    """The context in which programs are lowered for an H100."""
    device = jax.sharding.AbstractDevice("NVIDIA H100", 132, "gpu")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    return jax.sharding.use_abstract_mesh(mesh)
