"""The examples run, at sizes that take seconds."""

from __future__ import annotations

import importlib.util
import itertools
import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def pictures_in(path):
    """All images of a file, (num_frames, height, width, 3) uint8."""
    with Image.open(path) as opened:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(opened)]
    return np.stack(frames)


@pytest.mark.slow  # `make demo` runs it in full
@pytest.mark.parametrize(("solved", "steps"), [("995", 512), ("1", 256)])
def test_train_inverted_pendulum(tmp_path, solved, steps):
    figures = load("train_inverted_pendulum").main(
        [
            *("--output-dir", str(tmp_path), "--num-envs", "8", "--num-steps", "16"),
            *("--total-steps", "512", "--eval-every", "200", "--solved-return", solved),
            *("--eval-episodes", "2", "--video-steps", "10"),
        ]
    )
    assert figures["train_steps"] == steps, "it stops when the task is solved"
    assert [one["steps"] for one in figures["evaluations"]] == [256, 512][: steps // 256]
    assert len(figures["evaluations"][-1]["returns"]) == 2
    assert json.loads((tmp_path / "figures.json").read_text()) == figures
    for name in ("learning_curve.png", "trained_agent.mp4"):
        assert (tmp_path / name).stat().st_size > 1000


@pytest.mark.slow
def test_a_stopped_demo_leaves_what_it_has(tmp_path, monkeypatch):
    demo = load("train_inverted_pendulum")
    update = demo.update

    def stop(*arguments):
        update(*arguments)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(demo, "update", stop)
    handler = signal.getsignal(signal.SIGTERM)
    figures = demo.main(
        [
            *("--output-dir", str(tmp_path), "--num-envs", "8", "--num-steps", "16"),
            *("--total-steps", "512", "--eval-episodes", "2", "--video-steps", "10"),
        ]
    )
    assert figures["train_steps"] == 128
    assert [one["steps"] for one in figures["evaluations"]] == [128]
    names = {"figures.json", "learning_curve.png", "trained_agent.mp4"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert signal.getsignal(signal.SIGTERM) is handler


SMALL = ("--num-envs", "8", "--eval-episodes", "2")


# A step earns 1, and no pole falls within its first five.
SHORTEST = 5


@pytest.mark.slow
def test_torchrl_ppo(tmp_path):
    arguments = ["--output-dir", str(tmp_path), "--total-steps", "256", "--num-steps", "16"]
    figures = load("torchrl_ppo").main([*arguments, *SMALL])
    assert figures["train_steps"] == 256
    assert SHORTEST <= figures["eval_return_mean"] <= 1000


# Stable-Baselines3's progress bar warns that a part of tqdm is young.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_sb3_ppo(tmp_path):
    arguments = ["--output-dir", str(tmp_path), "--total-steps", "256"]
    figures = load("sb3_ppo").main([*arguments, *SMALL])
    assert figures["train_steps"] == 256
    assert SHORTEST <= figures["eval_return_mean"] <= 1000
    assert (tmp_path / "agent.zip").exists()


@pytest.mark.slow
def test_render_tasks(tmp_path):
    arguments = ["--output-dir", str(tmp_path), "--num-frames", "4", "--only", "reacher"]
    load("render_tasks").main(arguments)
    moving = pictures_in(tmp_path / "tasks" / "reacher.webp")
    assert moving.shape == (4, 120 + 16, 120, 3)
    assert (moving[0, :120] != moving[3, :120]).any()
    assert moving[:, 120:].min() < 100, "a name"
    # Nobody has learned it.
    assert not (tmp_path / "wall.webp").exists()
    (views,) = pictures_in(tmp_path / "views.png")
    assert views.shape == (120, 6 * 120 + 5 * 4, 3)
    images = [views[:, left : left + 120] for left in range(0, 6 * 124, 124)]
    for first, second in itertools.combinations(images, 2):
        assert np.abs(first.astype(int) - second).mean() > 1


@pytest.mark.slow
def test_render_tasks_of_dm_control(tmp_path, monkeypatch):
    pytest.importorskip("dm_control")
    example = load("render_tasks")
    monkeypatch.setattr(example, "DMC_TILES", ("pendulum_swingup", "point_mass_easy"))
    example.main(["--output-dir", str(tmp_path), "--num-frames", "3", "--suite", "dmc"])
    moving = pictures_in(tmp_path / "dmc" / "wall.webp")
    assert moving.shape == (3, 136, 2 * 120 + 4, 3)
    assert np.abs(moving[:, :, :120].astype(int) - moving[:, :, 124:]).mean() > 1


@pytest.mark.slow
def test_skrl_ppo(tmp_path):
    agent = load("skrl_ppo").main(
        ["--output-dir", str(tmp_path), "--num-envs", "4", "--timesteps", "64"]
    )
    # Two rollouts of 32 steps, each learned from in 4 epochs of 8 minibatches.
    assert {int(state["step"]) for state in agent.optimizer.state.values()} == {2 * 4 * 8}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.timeout(2400)
@pytest.mark.parametrize("name", ["torchrl_ppo", "sb3_ppo"])
def test_agents_learn(name, tmp_path):
    figures = load(name).main(["--output-dir", str(tmp_path)])
    assert figures["eval_return_mean"] >= 500


@pytest.mark.slow
def test_render_distractors(tmp_path):
    presets = ["none", "video-hard", "dcs-hard"]
    load("render_distractors").main(
        [
            *("--output-dir", str(tmp_path), "--num-frames", "3"),
            *("--tasks", "inverted_pendulum", "--presets", *presets),
        ]
    )
    assert {path.name for path in tmp_path.iterdir()} == {"levels.png", "motion.webp"}
    (levels,) = pictures_in(tmp_path / "levels.png")
    assert levels.shape == (345, 505, 3), "three rows, and three environments beside their names"
    plain, color, hard = levels[:115, 160:], levels[115:230, 160:], levels[230:, 160:]
    for row, name in zip((plain, color, hard), presets, strict=True):
        assert row.std() > 10, name
    assert (plain != color).any(axis=2).mean() > 0.8
    assert (plain != hard).any(axis=2).mean() > 0.8
    names = levels[:, :155]
    assert names.min() < 100, "legible"
    assert names[:, :2].min() == 255, "not cut"

    # Only what changes from frame to frame is shown in motion.
    animation = pictures_in(tmp_path / "motion.webp")
    assert animation.shape == (3, 20 + 168, 168 + 4 + 168, 3)
    assert animation[:, :20].min() < 100, "names"
    assert animation[:, 20:, :168].std() > 10
    assert animation[:, 20:, -168:].std() > 10
    steps = np.abs(np.diff(animation.astype(int), axis=0)).mean((1, 2, 3))
    assert (steps > 1).all()
