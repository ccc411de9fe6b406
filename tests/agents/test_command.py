"""``pixelbrax train`` and ``pixelbrax record``: options, errors, exit statuses."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as imageio
import jax
import pytest

from pixelbrax_gym.cli import main
from pixelbrax_gym.cli.train import parse
from pixelbrax_jax import registry
from pixelbrax_jax.agents.config import describe
from pixelbrax_jax.agents.presets import PRESETS, TASK_SETTINGS, preset
from pixelbrax_jax.agents.runner import train
from pixelbrax_jax.agents.runner.trained import load_config
from pixelbrax_jax.tasks import TASKS
from tests.benchmarks.experiments import (
    config_of,
    experiments,
    gpu_experiments,
    is_made,
    kept_at,
)
from tests.envs.toy import PARAMS, Ball

BALL = "ball_of_commands"

TINY = (
    *("--task", "inverted_pendulum", "--height", "18", "--width", "18", "--frame-stack", "1"),
    *("--encoder", "small", "--num-envs", "2", "--num-steps", "4", "--num-minibatches", "2"),
    *("--update-epochs", "1", "--total-steps", "16", "--no-progress"),
)


@pytest.fixture(scope="session", autouse=True)
def _ball_of_commands():
    registry.register(BALL, Ball, camera=PARAMS.rig)


@pytest.mark.parametrize(
    ("algorithm", "name"),
    [(algorithm, name) for name, settings in PRESETS.items() for algorithm in settings],
)
def test_every_preset_is_valid_and_comes_back_from_json(algorithm, name):
    config = preset(algorithm, name)
    stored = {"algorithm": algorithm, "config": describe(config) | {"seed": 3}}
    assert load_config(stored) == config


@pytest.mark.parametrize(
    ("algorithm", "task"),
    [
        (algorithm, task)
        for algorithm, of_tasks in TASK_SETTINGS["cpu"].items()
        for task in of_tasks
    ],
)
def test_a_preset_may_have_settings_of_a_task(algorithm, task):
    line = ["--preset", "cpu", "--task", task, "--num-steps", "64"]
    _, config, _ = parse(algorithm, line)
    assert config == preset(algorithm, "cpu", task, num_steps=64)
    wanted = TASK_SETTINGS["cpu"][algorithm][task] | {"task": task}
    assert {name: describe(config)[name] for name in wanted} == wanted


def test_cartpole_has_as_many_updates_as_other_tasks():
    cartpole, walker = (
        preset("drqv2", "cpu", task) for task in ("dmc_cartpole_swingup", "dmc_walker_walk")
    )
    assert cartpole.env.action_repeat == 4 * walker.env.action_repeat
    assert cartpole.replay_ratio == 4 * walker.replay_ratio
    assert cartpole.total_steps == walker.total_steps


def test_a_preset_without_settings_of_the_task_is_told(capsys):
    assert main(["train", "ppo", "--preset", "cpu", "--task", "pusher"]) == 1
    told = capsys.readouterr().err
    assert "the preset 'cpu' has no settings for task 'pusher'; use preset 'default'" in told
    assert "one of its tasks: ant, dmc_ball_in_cup_catch, dmc_cartpole" in told
    assert main(["train", "ppo", "--preset", "gpu"]) == 2
    assert "Did you mean 'cpu'" in capsys.readouterr().err


def test_options_change_a_preset():
    line = "--preset procgen --task walker2d --distractors video camera --seeds 5"
    _, config, options = parse("ppg", [*line.split(), "--no-normalize-reward"])
    assert config.env.task == "walker2d"
    assert config.env.distractors == ("video", "camera")
    assert config.aux_epochs == 6, "of the preset"
    assert not config.normalize_reward
    assert options.seeds == 5
    assert options.output_dir == "runs/ppg"


RUNS = experiments() | gpu_experiments()


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_of_the_results_are_valid(name):
    config = config_of(RUNS[name])
    assert name.startswith(f"{RUNS[name][1]}-{config.env.task}-")
    if name in gpu_experiments():
        assert config.total_steps >= 25_000_000
    # The largest buffer, that of PPG and DCPG, in bytes.
    frames = config.num_envs * (config.num_steps + 2) * config.env.height * config.env.width * 3
    assert frames * getattr(config, "num_policy_phases", 0) < 25e9


def test_a_kept_run_of_other_settings_is_not_taken_for_made(tmp_path):
    name, other = "ppo-walker2d-0", "ppo-walker2d-brax-0"
    assert is_made(kept_at(name), RUNS[name])
    assert not is_made(kept_at(other), RUNS[name])
    assert not is_made(tmp_path / "none.json", RUNS[name])


def test_errors_name_the_setting_and_the_cure(capsys):
    with pytest.raises(SystemExit):
        main(["train", "ppo", "--num-minibatches", "7"])
    assert "num_minibatches=7 must divide num_steps=64" in capsys.readouterr().err
    assert main(["train", "pppo"]) == 2
    assert "Did you mean 'ppo'?" in capsys.readouterr().err
    assert main(["train", "ppo", "--task", "antt"]) == 1
    assert "Did you mean 'ant'?" in capsys.readouterr().err
    assert main(["record", "/nowhere", "--size", "1000000"]) == 1
    assert "size=1000000, grid=3 would take at least" in capsys.readouterr().err
    assert main(["record", "/nowhere"]) == 1
    assert "no checkpoint in /nowhere/checkpoints, which does not exist" in capsys.readouterr().err
    assert main(["train", "--task", "ant"]) == 2
    assert "name an algorithm first, as in 'pixelbrax train ppo --task" in capsys.readouterr().err


def test_tasks_tell_what_is_missing(capsys, monkeypatch):
    monkeypatch.setattr("pixelbrax_gym.cli.tasks.find_spec", lambda name: None)
    assert main(["tasks"]) == 0
    told = capsys.readouterr()
    assert [line.split()[0] for line in told.out.splitlines()] == list(TASKS)
    assert 'dmc need dm_control: pip install "pixelbrax[dmc]"' in told.err


@pytest.mark.slow
def test_a_task_of_the_dm_control_suite_from_training_to_the_film(capsys, tmp_path):
    pytest.importorskip("dm_control", reason="has no release for the newest Python")
    folder = str(tmp_path)
    line = [*TINY, "--task", "dmc_cartpole_swingup", "--output-dir", folder]
    assert main(["train", "ppo", *line, "--action-repeat", "8", "--num-evals", "1"]) == 0
    capsys.readouterr()
    assert main(["evaluate", folder, "--episodes", "2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert 0.0 <= told["return"] <= 1000.0
    assert told["length"] == 1000.0, "no episode ends before the time limit"
    assert main(["evaluate", folder, "--episodes", "2", "--in", "dm_control_physics"]) == 0
    there = json.loads(capsys.readouterr().out)
    assert there["return"] == told["return"]
    # Episodes part in time, when single pixels round otherwise.
    assert abs(there["difference"]) < 5.0
    assert main(["record", folder, "--num-frames", "3", "--output", str(tmp_path / "a.gif")]) == 0
    assert len(imageio.imread(tmp_path / "a.gif", index=None)) == 3


@pytest.mark.parametrize(("given", "told"), [("0", "positive integer"), ("2", "comes too late")])
def test_devices_cannot_be_emulated_late(given, told, capsys):
    jax.devices()
    assert main(["train", "ppo", *TINY, "--cpu-devices", given]) == 1
    assert told in capsys.readouterr().err


def test_stopped_at_once_it_says_what_is_left(monkeypatch, capsys, tmp_path):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "train", stopped)
    line = ["train", "ppo", *TINY, "--output-dir", str(tmp_path)]
    assert main(line) == 130
    assert "stopped at once; there is no checkpoint" in capsys.readouterr().err
    (tmp_path / "checkpoints" / "64" / "about").mkdir(parents=True)
    (tmp_path / "checkpoints" / "64" / "about" / "metadata").touch()
    assert main(line) == 130
    assert "the checkpoint of 64 steps with --resume latest" in capsys.readouterr().err


def test_the_exit_status_tells_the_signal_that_stopped_it(monkeypatch, tmp_path):
    monkeypatch.setattr(train, "train", lambda *_: SimpleNamespace(signal=signal.SIGTERM))
    assert main(["train", "ppo", *TINY, "--output-dir", str(tmp_path)]) == 128 + signal.SIGTERM


@pytest.mark.parametrize("given", ["--coordinator h:1 --num-processes 2", "--process-id 1"])
def test_a_process_is_not_left_alone_silently(given, capsys):
    assert main(["train", "ppo", *given.split()]) == 2
    assert "belong together" in capsys.readouterr().err


def test_without_arguments_it_tells_what_there_is(capsys):
    assert main(["train"]) == 0
    assert "{ppo,ppg,dcpg,drqv2}" in capsys.readouterr().out


# imageio never closes FFmpeg's pipes itself.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_run_is_evaluated_and_recorded(tmp_path, capsys):
    folder = str(tmp_path / "run")
    # A critic that sees the state: in the video there are pixels alone.
    line = ["train", "ppo", *TINY, "--output-dir", folder, "--num-evals", "1", "--state-critic"]
    assert main([*line, "--task", BALL, "--episode-length", "9"]) == 0
    told = capsys.readouterr().err
    assert "compiling" in told
    assert "clean: return" in told
    assert "done after 16 steps" in told
    evaluation = [json.loads(line) for line in (Path(folder) / "metrics.jsonl").open()][-1]
    assert main(["evaluate", folder, "--episodes", "32"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["return"] == evaluation["eval/clean/return"]
    assert again["standard_error"] == evaluation["eval/clean/standard_error"]
    assert (again["steps"], again["split"]) == (16, "clean")
    assert main(["evaluate", folder, "--split", "test"]) == 1
    assert "the run has none; its splits: 'clean'." in capsys.readouterr().err
    video = str(tmp_path / "video.mp4")
    line = ["record", folder, "--output", video, "--grid", "3", "--size", "15", "--num-frames", "3"]
    assert main(line) == 0
    frames = imageio.imread(video)
    assert frames.shape == (3, 46, 46, 3), "an odd side is padded"
    assert frames[0].std() > 5, "something is seen"
    for wrong, told in (
        ("--best --steps 16", "give best or steps, not both; got steps=16"),
        ("--run 1", "run must be from 0 to 0, got 1"),
        ("--split tset", "Did you mean 'test'?"),
        ("--steps 3", "existing checkpoints have 16 steps"),
        ("--output a.avi", "one of .gif, .mp4, got 'a.avi'"),
        ("--seed 4294967296", "seeds must lie in [0, 2**32), got 4294967296"),
    ):
        assert main(["record", folder, *wrong.split()]) == 1
        assert told in capsys.readouterr().err
