"""Runs whose clips, module or folder are elsewhere than they were; a task of the user's own."""

from __future__ import annotations

import json
import shutil
import sys

import jax
import numpy as np
import pytest

from pixelbrax_gym.cli import main
from pixelbrax_jax import make, named_rigs, registry
from pixelbrax_jax.agents.runner.checkpoint import read_about
from tests.agents.small import OPTIONS, PARAMS
from tests.agents.test_splits import write_clips

MODULE = """
import pixelbrax_jax
from tests.envs.toy import Ball, PARAMS

pixelbrax_jax.register("my_ball", Ball, camera=PARAMS.rig)
"""
SETTINGS = (
    *(f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()),
    *("--episode-length", "4", "--encoder", "small", "--num-envs", "2", "--num-steps", "4"),
    *("--num-minibatches", "2", "--update-epochs", "1", "--no-progress"),
)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The current folder, which has the module ``my_tasks``."""
    monkeypatch.setattr(registry, "_OWN_TASKS", {})
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "cache"))
    (tmp_path / "my_tasks.py").write_text(MODULE)
    (tmp_path / "broken.py").write_text("import no_such_library")
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").touch()
    (tmp_path / "my_package" / "tasks.py").write_text("from my_package import missing")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in ("my_tasks", "my_package"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("task", "told"),
    [
        ("my_tusks:my_ball", "there is no module 'my_tusks' for task 'my_tusks:my_ball'"),
        ("my_tusks:my_ball", "Did you mean 'my_tasks'?"),
        ("my_tasks.more:my_ball", "there is no module 'my_tasks.more'"),
        ("my_tasks:my_bell", "registers no task 'my_bell'; registered tasks: my_ball"),
        ("my_tasks:ant", "registers no task 'ant'"),
        ("my_tasks.py:my_ball", "there is no module 'my_tasks.py'"),
        ("my-tasks:my_ball", "must be NAME or MODULE:NAME"),
        (":my_ball", "must be NAME or MODULE:NAME"),
        (
            "broken:my_ball",
            "module 'broken' of task 'broken:my_ball' cannot be imported: No module",
        ),
        (
            "my_package.tasks:my_ball",
            "module 'my_package.tasks' of task 'my_package.tasks:my_ball' cannot be imported: "
            "cannot import name 'missing'",
        ),
    ],
)
def test_a_task_that_no_module_registers_is_told(home, task, told, capsys):
    assert main(["train", "ppo", "--task", task, *SETTINGS, "--output-dir", "run"]) == 1
    assert told in capsys.readouterr().err
    assert main(["play", task]) == 1
    assert told in capsys.readouterr().err


def test_an_own_task_is_the_one_that_its_module_registers(home, monkeypatch):
    monkeypatch.syspath_prepend(home)
    options = OPTIONS | {"obs_mode": "state"}
    env, params = make("my_tasks:my_ball", **options)
    assert env == make("my_ball", **options)[0]
    jax.tree.map(np.testing.assert_array_equal, params.rig, PARAMS.rig)
    assert named_rigs("my_tasks:my_ball").keys() == named_rigs("my_ball").keys()


def rows(told: str) -> dict[str, dict]:
    found = map(json.loads, told.splitlines())
    return {row["split"]: row for row in found}


@pytest.fixture
def train(home):
    """The command that trains in ``run``, and has done so with clips that have a copy.

    More options may follow.
    """
    write_clips(home / "clips", "ab")
    write_clips(home / "others", "cd")
    shutil.copytree(home / "clips", home / "node" / "staged")
    line = ["train", "ppo", "--task", "my_tasks:my_ball", *SETTINGS, "--output-dir", "run"]
    line += ["--distractors", "video", "--split", "all", "--total-steps", "8"]
    assert main([*line, "--clips", "clips"]) == 0
    return line


def test_a_run_goes_on_wherever_its_clips_lie(home, train, monkeypatch, capsys):
    about = read_about("run/checkpoints")
    assert about["config"]["clips"] == str(home / "clips")
    assert about["config"]["task"] == "my_tasks:my_ball"
    assert len(about["clips"]) == 2
    capsys.readouterr()

    # The content decides, and not the name.
    again = [*train, "--resume", "latest", "--clips"]
    assert main([*again, "others"]) == 1
    told = capsys.readouterr().err
    assert f"clips: those of '{home}/clips' there, different ones in '{home}/others' here" in told
    assert main([*again, "node/staged"]) == 0
    assert "continuing from the checkpoint of 8 steps" in capsys.readouterr().err

    # From another folder, where the path of the training would not be found.
    (home / "elsewhere").mkdir()
    monkeypatch.chdir(home / "elsewhere")
    of_run = [str(home / "run"), "--split", "train", "--clips", "../others"]
    for command in ("evaluate", "record"):
        assert main([command, *of_run]) == 1
        assert "differ from those of the training" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_is_played_wherever_its_clips_lie(home, train, monkeypatch, capsys):
    assert (
        main([*train, "--total-steps", "16", "--resume", "latest", "--clips", "node/staged"]) == 0
    )
    shutil.rmtree(home / "clips")
    (home / "elsewhere").mkdir()
    monkeypatch.chdir(home / "elsewhere")
    capsys.readouterr()
    of_run = ["evaluate", str(home / "run"), "--episodes", "1"]
    assert main([*of_run, "--steps", "8"]) == 1
    told = capsys.readouterr()
    assert rows(told.out).keys() == {"clean"}
    assert f"there is no folder of clips at {home}/clips" in told.err
    assert "set their folder with --clips" in told.err
    assert main([*of_run, "--clips", "../node/staged"]) == 0
    told = capsys.readouterr()
    found = rows(told.out)
    assert found.keys() == {"clean", "train"}
    assert found["train"]["clips"] == f"{home}/elsewhere/../node/staged"
    assert "clips" not in found["clean"]
    assert (found["train"]["steps"], found["train"]["seed"]) == (16, 0)
    assert "no split 'test': training uses 2 of the 2 clips of split 'all'" in told.err
    assert main([*of_run, "--clips", "../others", "--split", "test"]) == 0
    assert rows(capsys.readouterr().out)["test"]["clips"] == f"{home}/elsewhere/../others"
    assert main([*of_run, "--clips", "../others", "--split", "train"]) == 1
    assert "differ from those of the training" in capsys.readouterr().err
    # A run of a release that stored no digests.
    path = home / "run" / "checkpoints" / "16" / "about" / "metadata"
    about = json.loads(path.read_text())
    path.write_text(json.dumps({n: v for n, v in about.items() if n != "clips"}))
    assert main([*of_run, "--clips", "../others", "--split", "train"]) == 1
    assert "differ from those of the training" in capsys.readouterr().err
    (home / "node" / "staged").rename(home / "node" / "gone")
    assert main([*of_run, "--clips", "../others", "--split", "train"]) == 0
    told = capsys.readouterr()
    assert "has no digest of its clips; assuming that ../others has the same clips" in told.err
    assert rows(told.out)["train"]["clips"] == f"{home}/elsewhere/../others"
    path.write_text(json.dumps(about))
    video = ["--num-frames", "2", "--grid", "1", "--size", "18", "--output", "a.gif"]
    assert main(["record", str(home / "run"), "--clips", "../others", *video]) == 1
    assert "differ from those of the training" in capsys.readouterr().err
    assert main(["record", str(home / "run"), "--clips", "../node/gone", *video]) == 0
    assert (home / "elsewhere" / "a.gif").stat().st_size > 0


def test_clips_for_a_run_without_any_are_refused(capsys):
    line = ["evaluate", "--pretrained", "halfcheetah", "--clips", "procedural"]
    assert main(line) == 1
    assert (
        "needs a run with a video distractor; its distractors are none" in capsys.readouterr().err
    )
