"""Policies in another simulator: the same starts, frames and time limits, and paired returns."""

from __future__ import annotations

import json
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_gym.cli import evaluate, main
from pixelbrax_jax import PixelEnv, make
from pixelbrax_jax.agents import PPOConfig
from pixelbrax_jax.agents.runner.evaluate import Evaluator, Result, paired
from pixelbrax_jax.agents.runner.trained import Pretrained, Trained
from pixelbrax_jax.agents.runner.transfer import play_in
from tests.envs.toy import Ball, limited
from tests.opengl import need_opengl
from tests.physics.dmc import oracle  # noqa: F401  # no OpenGL, unless one is chosen

EPISODES = 3


def player(policy: Any) -> Pretrained:
    return Pretrained(PPOConfig(), policy)


def waver(obs: jax.Array) -> jax.Array:
    """Actions (B, 1) that depend smoothly on all of an observation."""
    flat = obs.reshape(len(obs), -1).astype(jnp.float32)
    return jnp.sin(flat @ jnp.linspace(-1.0, 1.0, flat.shape[1])[:, None] / flat.shape[1])


def suite_env(task: str, **options: Any) -> Any:
    pytest.importorskip("dm_control.suite", exc_type=ImportError)
    from pixelbrax_jax.physics.dmc.suite import SuiteEnv

    return SuiteEnv(task, **options)


class Track:
    """A simulator of the ball that remembers what it is told; its picture is the step's number."""

    def __init__(self) -> None:
        self.starts, self.actions = [], []

    def start(self, state: Any) -> None:
        self.x, self.count = float(state.engine[0]), 0
        self.starts.append(self.x)

    def step(self, action: np.ndarray) -> float:
        self.actions.append(float(action[0]))
        self.x, self.count = self.x + 0.1 * float(action[0]), self.count + 1
        return self.x

    def observe(self) -> np.ndarray:
        return np.array([self.x, self.count], np.float32)

    def render(self) -> np.ndarray:
        return np.full((8, 8, 3), self.count, np.uint8)


def test_the_paired_difference():
    here, there = np.array([1.0, 2.0, 4.0, 9.0]), np.array([2.0, 2.0, 3.0, 14.0])
    lengths = np.full(4, 5)
    found = paired(Result(here, lengths), Result(there, lengths))
    differences = [1.0, 0.0, -1.0, 5.0]
    mean = sum(differences) / 4
    error = math.sqrt(sum((x - mean) ** 2 for x in differences) / 3 / 4)
    # The 97.5 % quantile of Student's t with 3 degrees of freedom, from a table.
    reach = 3.182446 * error
    assert found == pytest.approx(
        {
            "return_there": 5.25,
            "difference": mean,
            "difference_standard_error": error,
            "difference_low": mean - reach,
            "difference_high": mean + reach,
        },
        rel=1e-6,
    )
    alone = paired(Result(here[:1], lengths[:1]), Result(there[:1], lengths[:1]))
    assert alone == {"return_there": 2.0, "difference": 1.0}


def test_frames_are_stacked_and_actions_repeated_up_to_the_time_limit():
    env = PixelEnv(Ball(), height=8, width=8, frame_stack=3, action_repeat=2)
    track, told = Track(), []

    def policy(pixels: jax.Array) -> jax.Array:
        return pixels[:, 0, 0, ::3] @ jnp.array([[0.1], [0.01], [0.001]])  # oldest first

    options = {"num_episodes": 2, "report": told.append}
    result = play_in(track, player(policy), {}, env, limited(5), **options)
    actions = [0.0, 0.0, 0.002, 0.002, 0.024]
    np.testing.assert_allclose(track.actions, 2 * actions, rtol=1e-6)
    x = np.array(track.starts)[:, None] + 0.1 * np.cumsum(actions)
    np.testing.assert_allclose(result.returns, x.sum(axis=1), rtol=1e-6)
    assert result.lengths.tolist() == [5, 5]
    assert told[1].startswith("episode 2 of 2: return ")


def test_an_environment_that_also_shows_the_state_gives_equal_returns():
    def returns(obs_mode):
        env = PixelEnv(Ball(), height=8, width=8, frame_stack=2, obs_mode=obs_mode)
        agent = player(lambda pixels: pixels.astype(jnp.float32).mean((1, 2, 3))[:, None] / 255)
        return Evaluator(agent, env, limited(5), num_episodes=2)({}).returns

    np.testing.assert_array_equal(returns("both"), returns("pixels"))
    assert returns("pixels").any()


def test_it_shows_the_states_of_our_physics():
    env = PixelEnv(Ball(), height=8, width=8, frame_stack=2, action_repeat=2)
    track, agent = Track(), player(lambda pixels: jnp.full((len(pixels), 1), 0.5))
    ours = Evaluator(agent, env, limited(5), num_episodes=2)({})
    shown = play_in(track, agent, {}, env, limited(5), num_episodes=2, physics=False)
    np.testing.assert_allclose(shown.returns, ours.returns, rtol=1e-6)
    assert shown.lengths.tolist() == ours.lengths.tolist() == [5, 5]
    assert not track.actions
    first = track.starts[0]
    expected = [first, first + 0.1, first + 0.2, first + 0.25]
    np.testing.assert_allclose(track.starts[:4], expected, rtol=1e-5)


@pytest.mark.parametrize(
    "task", ["dmc_cartpole_swingup", pytest.param("dmc_walker_walk", marks=pytest.mark.slow)]
)
def test_returns_in_dm_control_are_ours(task):
    simulator = suite_env(task)
    options = {"obs_mode": "state", "action_repeat": 2, "episode_length": 41}
    env, params = make(task, engine="mujoco", **options)
    size = env.action_size
    agent = player(lambda obs: jnp.tile(waver(obs), (1, size)))
    options = {"num_episodes": EPISODES}
    ours = Evaluator(agent, env, params, **options)({})
    theirs = play_in(simulator, agent, {}, env, params, **options)
    np.testing.assert_allclose(theirs.returns, ours.returns, rtol=1e-4)
    assert theirs.lengths.tolist() == ours.lengths.tolist() == [41] * EPISODES
    assert np.ptp(ours.returns) > 1e-3, "the starts differ"


OPTIONS = {"task": "dmc_cartpole_swingup", "height": 36, "width": 36, "frame_stack": 2}
LINE = ["evaluate", "runs/x", "--episodes", "2", "--in"]


def is_loaded(monkeypatch: pytest.MonkeyPatch, policy: Any = waver, **options: Any) -> None:
    config = PPOConfig().replace(**OPTIONS | {"episode_length": 30, "action_repeat": 4} | options)
    agent = Trained(Pretrained(config, policy), {}, 16)
    monkeypatch.setattr(evaluate, "load", lambda *_: agent)


@pytest.mark.slow
def test_our_picture_of_dm_controls_physics_is_the_same(monkeypatch, capsys):
    pytest.importorskip("dm_control.suite", exc_type=ImportError)
    is_loaded(monkeypatch, distractors=("color",))
    assert main([*LINE, "dm_control_physics"]) == 0
    told = capsys.readouterr()
    row = json.loads(told.out)
    assert (row["task"], row["in"]) == ("dmc_cartpole_swingup", "dm_control_physics")
    assert (row["split"], row["steps"], row["episodes"], row["length"]) == ("clean", 16, 2, 30.0)
    # Single pixels round otherwise.
    assert row["return_there"] == pytest.approx(row["return"], rel=1e-3)
    assert row["difference_low"] <= row["difference"] <= row["difference_high"]
    assert "distractors=('color',) of the run are left out" in told.err
    assert "dm_control_physics: episode 2 of 2: return" in told.err


def test_dm_controls_picture(monkeypatch, capsys):
    pytest.importorskip("dm_control.suite", exc_type=ImportError)
    need_opengl()
    is_loaded(monkeypatch, lambda pixels: jnp.ones((len(pixels), 1)), look="original")
    for where in ("dm_control_picture", "dm_control"):
        assert main([*LINE, where]) == 0
        told = capsys.readouterr()
        row = json.loads(told.out)
        # The policy is blind.
        assert row["return_there"] == pytest.approx(row["return"], rel=1e-4)
        assert "dm_control shows its own look, not look='original'" in told.err


@pytest.mark.parametrize(
    ("options", "line", "message"),
    [
        ({"task": "ant"}, "dm_control", "needs a task of the DM Control Suite, but the task of"),
        (
            {"obs_mode": "depth"},
            "dm_control",
            "shows pixels of one camera, but the run",
        ),
        ({"camera": ("fixed", "top")}, "dm_control_physics", "evaluate it without --in."),
        ({}, "dm_control --split train", "plays split clean alone, because dm_control has no"),
        ({}, "dm_control --clips procedural", "leave out --clips and --split."),
        ({"camera": "front"}, "dm_control", "camera of 'cartpole': 'front'; allowed: fixed,"),
        ({}, "dm_control", "--in dm_control: dm_control has no OpenGL with MUJOCO_GL unset: there"),
        ({}, "dm_control_picture", "--in dm_control_physics takes our picture instead."),
    ],
)
def test_what_cannot_be_played_is_told(monkeypatch, capsys, options, line, message):
    suite_env("dmc_pendulum_swingup")  # imports dm_control with the OpenGL that is chosen
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    is_loaded(monkeypatch, **options)
    assert main([*LINE, *line.split()]) == 1
    assert message in capsys.readouterr().err


def test_a_pretrained_policy_of_another_suite_is_told(capsys):
    assert main(["evaluate", "--pretrained", "halfcheetah", "--in", "dm_control"]) == 1
    assert "but the task of the run is 'halfcheetah'; allowed: dmc_" in capsys.readouterr().err
