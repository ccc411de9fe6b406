"""The examples run, at sizes that take seconds."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow  # `make demo` runs it in full
def test_train_inverted_pendulum(tmp_path):
    figures = load("train_inverted_pendulum").main(
        [
            *("--output-dir", str(tmp_path), "--num-envs", "8", "--num-steps", "16"),
            *("--total-steps", "256", "--eval-episodes", "2", "--video-steps", "10"),
        ]
    )
    assert figures["train_steps"] == 256
    assert len(figures["eval_returns"]) == 2
    assert json.loads((tmp_path / "figures.json").read_text()) == figures
    for name in ("learning_curve.png", "trained_agent.mp4"):
        assert (tmp_path / name).stat().st_size > 1000


SMALL = ("--num-envs", "8", "--eval-episodes", "2")


def test_torchrl_ppo(tmp_path):
    arguments = ["--output-dir", str(tmp_path), "--total-steps", "256", "--num-steps", "16"]
    figures = load("torchrl_ppo").main([*arguments, *SMALL])
    assert figures["train_steps"] == 256
    assert figures["eval_return_mean"] > 0


# Stable-Baselines3's progress bar warns that a part of tqdm is young.
@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_sb3_ppo(tmp_path):
    arguments = ["--output-dir", str(tmp_path), "--total-steps", "256"]
    figures = load("sb3_ppo").main([*arguments, *SMALL])
    assert figures["train_steps"] == 256
    assert figures["eval_return_mean"] > 0
    assert (tmp_path / "agent.zip").exists()


def test_skrl_ppo(tmp_path):
    agent = load("skrl_ppo").main(
        ["--output-dir", str(tmp_path), "--num-envs", "4", "--timesteps", "64"]
    )
    assert agent is not None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["torchrl_ppo", "sb3_ppo"])
def test_agents_learn(name, tmp_path):
    figures = load(name).main(["--output-dir", str(tmp_path)])
    assert figures["eval_return_mean"] >= 500
