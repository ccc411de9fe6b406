"""Any policy plays the same episodes as a trained agent; files continue; errors tell the fix."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pixelbrax_gym import evaluate_suite
from pixelbrax_gym.cli import _suite, main
from pixelbrax_gym.cli._agents import name_of
from pixelbrax_jax.agents import PPOConfig
from pixelbrax_jax.agents.runner.trained import Pretrained, Trained
from pixelbrax_jax.generalisation.suites import SUITES
from tests.generalisation.conftest import TASK, TINY

LEVELS = ["clean", "turned", "painted"]


def remainders(pixels):
    """Actions that depend on every pixel, with the same bits in all libraries."""
    return pixels.reshape(len(pixels), -1).sum(1) % 7


def of_numpy(obs):
    return remainders(obs.astype(np.int32)).astype(np.float32)[:, None] / np.float32(8) - 0.25


def of_jax(obs):
    return remainders(obs.astype(jnp.int32)).astype(jnp.float32)[:, None] / 8 - 0.25


def evaluate(policy, **more):
    return evaluate_suite(policy, TASK, "tiny", **TINY | more)


def agent(policy=of_jax, seed=0, **settings):
    options = {"task": TASK, "encoder": "small"} | TINY | settings
    config = PPOConfig().replace(**options)
    return Trained(Pretrained(config, policy), {}, 16, seed)


@pytest.fixture
def runs(monkeypatch):
    """Runs by folder, instead of those on disk."""
    known = {}
    monkeypatch.setattr(
        _suite, "load", lambda options, folder: known[folder][options.run_index], raising=True
    )
    monkeypatch.setattr(
        "pixelbrax_jax.agents.runner.trained.num_runs", lambda folder: len(known[folder])
    )
    return known


def command(*arguments):
    return main(["evaluate", *map(str, arguments), "--suite", "paper", "--episodes", "3"])


def test_policies_of_all_libraries_have_equal_returns(tmp_path):
    torch = pytest.importorskip("torch")

    def of_torch(obs):
        assert isinstance(obs, torch.Tensor)
        return remainders(obs.to(torch.int32)).to(torch.float32)[:, None] / 8 - 0.25

    found = evaluate(of_numpy).returns["policy"]
    assert list(found) == LEVELS
    assert {len(returns) for returns in found.values()} == {3}
    assert found["turned"] != found["clean"]
    assert found["painted"] != found["clean"]
    assert evaluate(of_numpy).returns["policy"] == found
    assert evaluate(of_jax, output="jax").returns["policy"] == found
    assert evaluate(of_torch, output="torch").returns["policy"] == found


@pytest.mark.slow
def test_episodes_are_those_of_the_command(runs, capsys, tmp_path):
    runs["a"] = [agent(seed=0), agent(lambda obs: -of_jax(obs), seed=1)]
    where = ["--clips", "procedural", "--output-dir", tmp_path]
    assert command("a", *where) == 0
    told = capsys.readouterr()
    assert "3 levels in 3 programs" in told.err
    assert told.out.splitlines()[0].startswith("| level")
    assert len(told.out.splitlines()) == 6
    written = json.loads((tmp_path / "returns.json").read_text())
    ours = written["returns"]["a, seed 0, 16 steps, e3b0c442"]
    options = TINY | {"clips": "procedural", "episodes": 3}
    theirs = evaluate_suite(of_numpy, TASK, "paper", **options).returns["policy"]
    assert list(ours) == list(theirs)
    for name, returns in theirs.items():
        np.testing.assert_allclose(ours[name], returns, rtol=1e-6)
    with Image.open(tmp_path / "levels.png") as sheet:
        assert sheet.size == (3 * 182, 196)
    # Nothing is played again, and another seed is added.
    runs["b"] = [agent(lambda obs: 0.5 * of_jax(obs), seed=2)]
    assert command("a", "b", *where) == 0
    again = capsys.readouterr()
    assert again.err.count("from the file") == 6
    rewritten = json.loads((tmp_path / "returns.json").read_text())
    assert rewritten["returns"].items() > written["returns"].items()


def test_a_stopped_call_continues_with_equal_returns(tmp_path):
    whole = evaluate(of_numpy)
    calls = []

    def policy(obs):
        calls.append(len(obs))
        return of_numpy(obs)

    def stop(line):
        if line.startswith("turned"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(policy, output_dir=tmp_path, report=stop)
    assert list(json.loads((tmp_path / "returns.json").read_text())["returns"]["policy"]) == [
        "clean",
        "turned",
    ]
    first = len(calls)
    lines = []
    with pytest.warns(UserWarning, match="2 levels of policy were not played, because"):
        rest = evaluate(policy, output_dir=tmp_path, report=lines.append)
    assert rest.returns == whole.returns
    assert len(calls) == first * 3 // 2
    assert [line.endswith("from the file") for line in lines] == [True, True, False]
    assert (tmp_path / "table.csv").read_text() == whole.csv()
    # What counts as a success changes no return.
    lowest = min(min(returns) for returns in whole.returns["policy"].values())
    with pytest.warns(UserWarning, match="3 levels of policy were not played"):
        again = evaluate(policy, output_dir=tmp_path, success_return=lowest)
    assert [row.success for row in again.rows()] == [1.0] * 4
    assert (tmp_path / "table.csv").read_text() == again.csv() != whole.csv()
    assert "success" not in (tmp_path / "returns.json").read_text()
    assert len(calls) == first * 3 // 2
    with pytest.raises(ValueError, match=r"has episodes=3, this call 4: .* Choose another folder"):
        evaluate(policy, output_dir=tmp_path, episodes=4)
    with pytest.raises(ValueError, match="has action_repeat=1, this call 2"):
        evaluate(policy, output_dir=tmp_path, action_repeat=2)
    for text in ("[]", '{"returns": {}}', '{"returns": {}, "options": 3}'):
        (tmp_path / "returns.json").write_text(text)
        with pytest.raises(ValueError, match="has no returns of a suite"):
            evaluate(policy, output_dir=tmp_path)


@pytest.mark.parametrize(("keeps", "said"), [(True, "goes on with"), (False, "nothing is kept")])
def test_a_stopped_command_says_what_it_keeps(keeps, said, runs, capsys, monkeypatch, tmp_path):
    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("pixelbrax_gym.generalisation.scores.play", stop)
    runs["a"] = [agent()]
    where = ["--output-dir", tmp_path] if keeps else []
    assert command("a", "--clips", "procedural", *where) == 130
    assert f"stopped; {'the same command ' if keeps else ''}{said}" in capsys.readouterr().err


def test_calls_at_once_keep_what_the_others_played(tmp_path):
    def while_playing(line):
        if line.startswith("turned"):
            evaluate({"other": lambda obs: -of_numpy(obs)}, output_dir=tmp_path)

    mine = evaluate({"mine": of_numpy}, output_dir=tmp_path, report=while_playing)
    assert list(mine.returns) == ["mine"]
    kept = json.loads((tmp_path / "returns.json").read_text())["returns"]
    assert {name: list(levels) for name, levels in kept.items()} == dict.fromkeys(
        ("mine", "other"), LEVELS
    )
    assert kept["mine"] == mine.returns["mine"]


def test_several_policies_are_seeds():
    found = evaluate({"one": of_numpy, "two": lambda obs: -of_numpy(obs)})
    assert list(found.returns) == ["one", "two"]
    assert "95 % interval" in found.markdown()


@pytest.mark.parametrize(
    ("policy", "more", "error", "message"),
    [
        (lambda obs: np.zeros(3, np.float32), {}, ValueError, r"of shape \(3, 1\), .* got \(3,\)"),
        (lambda obs: (of_numpy(obs), None), {}, ValueError, "got a tuple; of what predict of Stab"),
        (lambda obs: [[0.0]], {}, ValueError, r"of shape \(3, 1\), .* got \(1, 1\)"),
        (None, {}, TypeError, "policy 'policy' must be a function of observations, got None"),
        ({}, {}, ValueError, "at least one policy"),
        ({0: of_numpy}, {}, TypeError, "names of policies must be strings, got 0"),
        (
            lambda obs: jnp.array([[0.0], [jnp.nan], [0.0]]),
            {"output": "jax"},
            ValueError,
            "actions of episodes 1 contain NaN",
        ),
        (
            lambda obs: np.full((3, 1), "left"),
            {"output": "numpy"},
            TypeError,
            r"action must be floating point in \[-1, 1\], got <U4",
        ),
        (of_numpy, {"distractors": "color"}, TypeError, "distractors is decided by the levels"),
        (of_numpy, {"obs_mode": "state"}, ValueError, "obs_mode='state' shows none"),
        (of_numpy, {"heigth": 3}, TypeError, "unexpected keyword argument 'heigth'"),
        (of_numpy, {"episodes": 0}, ValueError, "episodes must be a positive integer"),
        (of_numpy, {"success_return": "9"}, ValueError, "success_return must be a finite number"),
    ],
)
def test_errors_of_a_call(policy, more, error, message):
    with pytest.raises(error, match=message):
        evaluate(policy, **more)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a", "tall", "--clips", "procedural"], "but height is 18 in a, seed 0, 16 steps, e3b0c"),
        (["a", "ant", "--clips", "procedural"], "but task is 'ball_of_suites' in a, seed 0"),
        (["a"], "suite 'paper' shows videos: give their folder"),
    ],
)
def test_errors_of_the_command(runs, capsys, arguments, message):
    runs |= {"a": [agent()], "tall": [agent(height=20)], "ant": [agent(task="ant")]}
    assert command(*arguments) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a", "a"], "run a is given twice"),
        (["a", "./a/"], "run ./a/ is given twice"),
        (["a", "--split", "clean"], "leave out --split"),
        (["a", "--run", "1"], "leave out --run"),
        ([], "--suite needs the folders of one or several runs"),
    ],
)
def test_a_wrong_command_line(runs, capsys, arguments, message):
    runs["a"] = [agent()]
    assert command(*arguments) == 2
    assert message in capsys.readouterr().err


def test_a_run_that_was_trained_again_has_another_name():
    first, again = (replace(agent(), networks={"actor": np.full(3, x)}) for x in (0.0, 1.0))
    assert name_of(first, "runs/a") == name_of(replace(first), "runs/a/")
    assert name_of(first, "runs/a") != name_of(again, "runs/a")


def test_clips_of_training_are_no_test(runs, capsys):
    runs["a"] = [agent(distractors="video", clips="procedural", split="test")]
    assert command("a", "--clips", "procedural") == 1
    assert "trained with 8 of the 8 clips of split 'test'" in capsys.readouterr().err


def test_options_of_a_suite_need_one(capsys):
    for arguments, message in (
        (["a", "b"], "give one run, or --suite for several; got a, b."),
        (["a", "--output-dir", "x"], "--output-dir needs --suite."),
        (["a", "--success-return", "9"], "--success-return needs --suite."),
        (
            ["a", "--suite", "axes", "--success-return", "nan"],
            "--success-return must be a finite number, got nan",
        ),
    ):
        assert main(["evaluate", *arguments]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "dataset"])
def test_suites_have_names(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    told = capsys.readouterr().out
    assert all(re.search(rf"\b{name}\b", told) for name in SUITES if name != "tiny")
    more = [] if command == "evaluate" else ["--level", "x", "--output-dir", "y"]
    assert main([command, "a", "--suite", "dmcgb3", *more]) == 2
    told = capsys.readouterr().err
    assert "unknown suite: 'dmcgb3'. Did you mean 'dmcgb" in told
    assert all(name in told for name in SUITES)
