"""Entries and tables of the leaderboard, from runs whose records are made here."""

from __future__ import annotations

import json
import math

import pytest

from pixelbrax_gym import cli
from pixelbrax_gym.cli._leaderboard import read, return_at
from pixelbrax_jax.agents.runner.checkpoint import FORMAT

SPEED = 100.0
"""Steps per second after the first record."""


def make_run(folder, task="ant", seed=0, returns=(10.0, 20.0, 40.0), every=1000, **config):
    """A run as training leaves it: 5 s of compilation, and evaluations that take 60 s each."""
    about = {
        "format": FORMAT,
        "algorithm": "ppo",
        "steps": every * len(returns),
        "config": {"task": task, "seed": seed, "seeds": 1, "distractors": []} | config,
        "versions": {"processor": "a CPU, 2 cores", "devices": "1 x cpu", "jax": "1.0"},
    }
    path = folder / "checkpoints" / str(about["steps"]) / "about"
    path.mkdir(parents=True)
    (path / "metadata").write_text(json.dumps(about))
    records, clock = [], 5.0
    for i in range(2 * len(returns)):
        clock += every / 2 / SPEED
        rate = SPEED if i else every / 2 / (5.0 + every / 2 / SPEED)
        steps = {"steps": (i + 1) * every // 2, "seconds": clock}
        records.append(steps | {"speed/steps_per_second": rate})
        if i % 2:
            clock += 60.0
            result = {"eval/clean/return": returns[i // 2], "eval/clean/standard_error": 1.0}
            records.append(steps | {"seconds": clock} | result)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in records))
    return str(folder)


def leaderboard(*arguments):
    return cli.main(["leaderboard", *map(str, arguments)])


def test_an_entry_has_seconds_of_training_alone(tmp_path):
    run = make_run(tmp_path / "run")
    assert leaderboard(run, "--folder", tmp_path / "board") == 0
    (one,) = read(tmp_path / "board")
    assert one["frames"] == [1000, 2000, 3000]
    assert one["seconds"] == [10.0, 20.0, 30.0]
    assert one["compile_seconds"] == 5.0
    assert one["return"] == [10.0, 20.0, 40.0]
    assert one["versions"]["processor"] == "a CPU, 2 cores"
    assert one["agent"] == one["algorithm"] == "ppo"


def test_returns_between_evaluations_are_interpolated(tmp_path):
    leaderboard(make_run(tmp_path / "run"), "--folder", tmp_path)
    (one,) = read(tmp_path)
    assert return_at(one, "seconds", 25.0) == 30.0
    assert return_at(one, "frames", 990) == 10.0
    assert return_at(one, "frames", 3050) == 40.0


def test_before_the_first_evaluation_and_after_the_end(tmp_path):
    leaderboard(make_run(tmp_path / "run"), "--folder", tmp_path)
    (one,) = read(tmp_path)
    assert math.isnan(return_at(one, "frames", 500))
    assert math.isnan(return_at(one, "seconds", 5.0))
    # More frames would have changed the policy; an hour after its end it is the same.
    assert math.isnan(return_at(one, "frames", 3100))
    assert return_at(one, "seconds", 3600.0) == 40.0


def test_the_table_has_a_row_for_each_task_and_agent(tmp_path, capsys):
    board = tmp_path / "board"
    for seed, scale in enumerate((1, 2, 3, 100)):
        returns = [scale, scale]
        run = make_run(tmp_path / str(seed), seed=seed, returns=returns, every=50_000)
        assert leaderboard(run, "--agent", "PPO, mine", "--folder", board) == 0
    published = {"agents": {"Other": {"seeds": 5, "returns": {"ant": {"500000": 7.2}}}}}
    (board / "published.json").write_text(json.dumps(published))
    capsys.readouterr()
    assert leaderboard("--folder", board) == 0
    _, _, ours, theirs = (
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in capsys.readouterr().out.splitlines()
    )
    # The first evaluation is after 500 seconds, the end after 1,000.
    assert ours == ["`ant`", "PPO, mine", "4", "", "2 (1 to 100)", "2 (1 to 100)", *ours[6:]]
    assert ours[6:] == ["2 (1 to 100)", "", "", "2 (1 to 100) at 0.1M"]
    assert theirs == ["`ant`", "Other, published", "5", "", "", "", "", "7", "", ""]


def test_a_cell_has_all_seeds_or_none(tmp_path, capsys):
    for seed, returns in enumerate(((1.0, 3.0), (1.0, 3.0, 5.0, 7.0, 9.0))):
        run = make_run(tmp_path / str(seed), seed=seed, returns=returns, every=100_000)
        assert leaderboard(run, "--folder", tmp_path / "board") == 0
    row = capsys.readouterr().out.splitlines()[-1].split("|")
    # 200,000 frames take 33 minutes, and the first evaluation is after 17.
    assert [cell.strip() for cell in row[4:10]] == ["", "", "3 (3 to 3)", "1 (1 to 1)", "", ""]


def test_another_run_is_not_overwritten(tmp_path, capsys):
    first, second = (make_run(tmp_path / str(i), returns=(i, i)) for i in (1, 2))
    assert leaderboard(first, "--folder", tmp_path / "board") == 0
    assert leaderboard(first, "--folder", tmp_path / "board") == 0
    assert leaderboard(second, "--folder", tmp_path / "board") == 1
    assert "name the agent otherwise with --agent" in capsys.readouterr().err


def test_runs_of_one_agent_differ_in_seeds_alone(tmp_path, capsys):
    board = tmp_path / "board"
    for seed, reward, status in ((0, "brax", 0), (1, "paper", 1), (2, "brax", 0)):
        run = make_run(tmp_path / str(seed), seed=seed, reward_preset=reward)
        assert leaderboard(run, "--folder", board) == status
    told = "reward_preset is 'paper' with seed 1 and 'brax' with seed 0 of the leaderboard"
    assert told in capsys.readouterr().err
    assert leaderboard(tmp_path / "1", "--agent", "by paper", "--folder", board) == 0


def test_runs_of_one_agent_have_one_algorithm(tmp_path, capsys):
    board = tmp_path / "board"
    assert leaderboard(make_run(tmp_path / "0"), "--agent", "mine", "--folder", board) == 0
    (path,) = board.iterdir()
    path.write_text(path.read_text().replace('"algorithm": "ppo"', '"algorithm": "dcpg"'))
    run = make_run(tmp_path / "1", seed=1)
    assert leaderboard(run, "--agent", "mine", "--folder", board) == 1
    assert "algorithm is 'ppo' with seed 1 and 'dcpg' with seed 0" in capsys.readouterr().err


def test_tasks_of_a_folder_have_entries(tmp_path, capsys):
    assert leaderboard(make_run(tmp_path / "run", task="my/arm"), "--folder", tmp_path) == 0
    assert "`my/arm`" in capsys.readouterr().out


def test_tasks_whose_names_differ_in_signs_need_other_agents(tmp_path, capsys):
    board = tmp_path / "board"
    first, second = (
        make_run(tmp_path / str(i), task=t) for i, t in enumerate(("my/arm", "my-arm"))
    )
    assert leaderboard(first, "--folder", board) == 0
    assert leaderboard(second, "--folder", board) == 1
    assert "belongs to agent 'ppo' on task 'my/arm': name" in capsys.readouterr().err
    assert leaderboard(second, "--agent", "other", "--folder", board) == 0


@pytest.mark.parametrize("text", ["{", "{}", '{"agents": []}'])
def test_published_returns_that_are_none(tmp_path, text, capsys):
    (tmp_path / "published.json").write_text(text)
    assert leaderboard("--folder", tmp_path) == 1
    assert f"{tmp_path / 'published.json'} of --folder has no 'agents'" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["{", "[]", '{"task": "ant"}'])
def test_other_files_are_no_entries(tmp_path, text, capsys):
    (tmp_path / "notes.json").write_text(text)
    assert leaderboard("--folder", tmp_path) == 1
    assert f"{tmp_path / 'notes.json'} of --folder is not an entry" in capsys.readouterr().err
    for path in (tmp_path / "notes.json", tmp_path / "none"):
        assert leaderboard("--folder", path) == 1
        assert f"--folder must be a folder with entries, and {path}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seeds": 2}, "seeds=2"),
        ({"distractors": ["color"]}, "distractors="),
        ({"dynamics": "mass=0.5:2"}, "dynamics='mass=0.5:2'"),
        ({"returns": (1.0,)}, "--num-evals"),
    ],
)
def test_a_run_that_does_not_fit_is_refused(tmp_path, capsys, changes, told):
    assert leaderboard(make_run(tmp_path / "run", **changes), "--folder", tmp_path) == 1
    assert told in capsys.readouterr().err
    assert not read(tmp_path)


def test_a_folder_without_a_run_is_named(tmp_path, capsys):
    assert leaderboard(tmp_path / "none", "--folder", tmp_path) == 1
    assert str(tmp_path / "none") in capsys.readouterr().err
