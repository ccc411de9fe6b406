"""The options that programs are compiled with."""

import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.compilation import _is_known
from pixelbrax_jax.types import GeomKind


@pytest.mark.parametrize(
    ("flags", "width"),
    [("", 512), ("--xla_cpu_prefer_vector_width=128", None)],
    ids=["ours", "the user's"],
)
def test_vectors_are_wide_unless_the_user_says_otherwise(monkeypatch, flags, width):
    monkeypatch.setenv("XLA_FLAGS", flags)
    options = pb.compiler_options(platform="cpu")
    assert options.get("xla_cpu_prefer_vector_width") == width
    program = jax.jit(lambda x: (x * 2.0).sum(), compiler_options=options)
    with jax.default_device(jax.devices("cpu")[0]):
        assert float(program(jnp.ones(64))) == 128


def test_options_are_those_of_the_default_device(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    assert pb.compiler_options() == {}
    for device in ("cpu", jax.devices("cpu")[0]):
        with jax.default_device(device):
            assert pb.compiler_options() == pb.compiler_options(platform="cpu") != {}


def test_a_platform_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    code = (
        "import jax, pixelbrax_jax\ntry: jax.devices()\nexcept Exception: pixelbrax_jax.make('ant')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        pytest.skip("there is a GPU")
    last = done.stderr.splitlines()[-1]
    assert last.startswith(
        "RuntimeError: JAX finds no device to compute on with JAX_PLATFORMS=cuda"
    )
    assert "unset it" in last


def test_options_are_those_of_the_environment(monkeypatch):
    pytest.importorskip("dm_control")
    monkeypatch.setenv("XLA_FLAGS", "")

    def options(env=None):
        return pb.compiler_options(env, platform="cpu")

    env, _ = pb.make("dmc_cartpole_swingup")
    brax, _ = pb.make("inverted_pendulum")
    own = options(env).items() - options().items()
    assert own == {("xla_cpu_experimental_ynn_fusion_type", "")}
    assert options(env) == options(pb.VectorPixelEnv(env, 2))
    assert options(brax) == options()
    emitters = "xla_cpu_use_fusion_emitters"
    most = ("humanoid_walk", "quadruped_walk", "swimmer_swimmer6", "swimmer_swimmer15")
    using = [task for task in most if emitters in options(pb.make(f"dmc_{task}")[0])]
    assert using == ["swimmer_swimmer15"] * _is_known(emitters, False)


def test_scenes_of_many_geoms_have_the_older_emitters(monkeypatch):
    import pixelbrax_jax.compilation as compilation

    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compilation, "_is_known", lambda option, value: True)
    for geoms, lamps, expected in ((50, 0, None), (51, 0, False), (25, 1, None), (26, 1, False)):
        physics = SimpleNamespace(
            compiler_options={},
            geoms=SimpleNamespace(kind=(GeomKind.SPHERE,) * geoms, num_planes=()),
            look=SimpleNamespace(lamps=(None,) * lamps),
        )
        options = compilation._options(physics, "cpu")
        assert options.get("xla_cpu_use_fusion_emitters") is expected
    physics.look = None  # only some physics has one
    assert compilation._options(physics, "cpu").get("xla_cpu_use_fusion_emitters") is None


def test_an_xla_without_the_option_is_left_alone(monkeypatch):
    import pixelbrax_jax.compilation as compilation

    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compilation, "_WIDTH", "xla_cpu_no_such_option")
    assert compilation.compiler_options() == {}


def test_on_a_gpu_loops_are_captured_unless_the_user_says_otherwise(monkeypatch):
    from pixelbrax_jax.compilation import compiler_options

    commands = "xla_gpu_enable_command_buffer"
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width=128")
    ours = compiler_options(platform="gpu")
    assert "WHILE" in ours[commands].split(",")
    assert compiler_options(platform="cuda") == ours
    with monkeypatch.context() as patch:
        patch.setattr("jax.default_backend", lambda: "gpu")
        assert compiler_options() == ours
    monkeypatch.setenv("XLA_FLAGS", f"--{commands}=-WHILE")
    assert compiler_options(platform="gpu") == {}
    assert compiler_options(platform="tpu") == {}


def test_an_unknown_platform_is_named():
    from pixelbrax_jax.compilation import compiler_options

    with pytest.raises(ValueError, match=r"unknown platform: 'cdua'\. Did you mean 'cuda'"):
        compiler_options(platform="cdua")


EVERYTHING = """
import sys
import gymnasium, numpy as np, torch
import pixelbrax_gym
import pixelbrax_jax as pb
from pixelbrax_gym.cli import main

assert pb.compiler_options()
small = {"height": 24, "width": 24}
envs = gymnasium.make_vec("PixelBrax/InvertedPendulum-v0", num_envs=2, **small)
envs.reset(seed=0)
envs.step(envs.action_space.sample())
td = pixelbrax_gym.TorchRLEnv("inverted_pendulum", 2, **small).rollout(2)
sb3 = pixelbrax_gym.SB3VecEnv("inverted_pendulum", 2, **small)
sb3.reset()
sb3.step(np.zeros((2, 1), np.float32))
folder = sys.argv[1]
train = "train ppg --preset ci --height 24 --width 24 --num-envs 4 --num-steps 8 --total-steps 128"
train += " --num-minibatches 2 --aux-minibatches 2 --num-policy-phases 2 --num-evals 1"
assert main([*train.split(), "--eval-episodes", "2", "--output-dir", folder]) == 0
assert main(["record", folder, "--grid", "1", "--size", "32", "--num-frames", "4"]) == 0
"""


@pytest.mark.slow
def test_everything_runs_with_our_own_options(monkeypatch, tmp_path):
    # The other tests name a width in XLA_FLAGS; then there are no options.
    monkeypatch.setenv("XLA_FLAGS", "")
    command = [sys.executable, "-W", "ignore", "-c", EVERYTHING, str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    assert list((tmp_path / "run" / "videos").glob("*.mp4"))
