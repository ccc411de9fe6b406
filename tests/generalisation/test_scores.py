"""Tables of returns against loops, and their files."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest

from pixelbrax_gym.generalisation.scores import ALL, Scores
from pixelbrax_jax.generalisation.intervals import interquartile_mean

LEVELS = ("clean", "easy", "hard")


def scores(num_runs: int, episodes: int = 4) -> Scores:
    random = np.random.default_rng(1)
    returns = {
        f"run {run}": {name: random.normal(100, 30, episodes).tolist() for name in LEVELS}
        for run in range(num_runs)
    }
    usual = {"episode_length": 1000, "reward_preset": "brax"}
    return Scores("tiny", "ball", {"episodes": episodes} | usual, returns)


def middle_mean(numbers) -> float:
    """Without a quarter of the numbers, rounded down, at each end."""
    ordered, cut = sorted(numbers), len(numbers) // 4
    kept = ordered[cut : len(ordered) - cut]
    return sum(kept) / len(kept)


@pytest.mark.parametrize("shape", [(1, 2), (1, 5), (3, 3), (12, 5)])
def test_the_interval_is_that_of_a_loop_over_strata(shape):
    strata = np.random.default_rng(2).normal(size=shape)
    random = np.random.default_rng(0)
    drawn = [random.integers(0, shape[1], (10_000, shape[1])) for _ in strata]
    means = [
        middle_mean([runs[j] for runs, of in zip(strata, drawn, strict=True) for j in of[i]])
        for i in range(10_000)
    ]
    mean, low, high = interquartile_mean(strata)
    assert mean == pytest.approx(middle_mean(strata.ravel()))
    np.testing.assert_allclose([low, high], np.quantile(means, [0.025, 0.975]))


@pytest.mark.parametrize("given", [[1.0], [[1.0], [2.0]], 3.0, np.zeros((0, 3))])
def test_one_run_has_no_interval(given):
    with pytest.raises(ValueError, match="at least 2 runs"):
        interquartile_mean(given)


def test_rows_of_one_run():
    found = scores(1)
    returns = found.returns["run 0"]
    rows = {row.level: row for row in found.rows()}
    assert list(rows) == [*LEVELS, ALL]
    for name in LEVELS:
        mean = sum(returns[name]) / 4
        spread = math.sqrt(sum((x - mean) ** 2 for x in returns[name]) / 3)
        assert rows[name].mean == pytest.approx(mean)
        assert rows[name].standard_error == pytest.approx(spread / 2)
        assert rows[name].ratio == pytest.approx(mean / rows["clean"].mean)
        assert math.isnan(rows[name].low)
    assert rows[ALL].mean == pytest.approx((rows["easy"].mean + rows["hard"].mean) / 2)
    head, _, clean, *_ = found.markdown().splitlines()
    assert [cell.strip() for cell in head.split("|")[1:-1]] == [
        "level",
        "return",
        "standard error",
        "ratio to clean",
    ]
    assert clean.split("|")[2].strip() == f"{rows['clean'].mean:.1f}"


def test_rows_of_several_runs():
    found = scores(5)
    means = {n: [np.mean(run[n]) for run in found.returns.values()] for n in LEVELS}
    rows = {row.level: row for row in found.rows()}
    for name in LEVELS:
        expected = interquartile_mean(np.array(means[name]))
        assert (rows[name].mean, rows[name].low, rows[name].high) == expected
        errors = [np.std(run[name], ddof=1) / 2 for run in found.returns.values()]
        assert rows[name].standard_error == pytest.approx(np.mean(errors))
    assert rows[ALL].mean == pytest.approx(middle_mean(means["easy"] + means["hard"]))
    assert rows[ALL].runs == 5
    text = found.markdown()
    assert "| return (IQM) | 95 % interval" in text
    lines = list(csv.DictReader(io.StringIO(found.csv())))
    assert [line["level"] for line in lines] == list(rows)
    assert float(lines[1]["low"]) == rows["easy"].low


@pytest.mark.parametrize(("task", "given"), [("ball", 105.0), ("dmc_walker_walk", None)])
def test_success_is_the_share_of_episodes_at_the_threshold(task, given):
    found = scores(3)
    if given is None:
        given, found.returns["run 0"]["easy"][0] = 500.0, 500.0
    else:
        found.success_return = given
    found.task = task
    rows = {row.level: row for row in found.rows()}
    for name, levels in (*((name, [name]) for name in LEVELS), (ALL, LEVELS[1:])):
        of_each = [x for run in found.returns.values() for level in levels for x in run[level]]
        assert rows[name].success == sum(x >= given for x in of_each) / len(of_each)
    assert rows["easy"].success > 0
    head, _, *lines = found.markdown().splitlines()
    assert head.split("|")[-2].strip() == f"success (from {given:g})"
    assert {row.success_return for row in rows.values()} == {given}
    assert [line.split("|")[-2].strip() for line in lines] == [
        f"{row.success:.2f}" for row in rows.values()
    ]


def test_a_task_without_a_threshold_has_no_success():
    for task, options in (
        ("ball", {}),
        ("walker2d", {}),
        ("dmc_walker_walk", {"episode_length": 250}),
        ("ant", {"reward_preset": "paper"}),
    ):
        found = scores(1)
        found.task, found.options = task, found.options | options
        assert all(math.isnan(row.success) for row in found.rows())
        assert "success" not in found.markdown()


def test_a_ratio_to_nothing_is_left_out():
    found = Scores("tiny", "ball", {"episodes": 1}, {"run": {"clean": [-2.0], "hard": [-3.0]}})
    clean, hard = found.rows()
    assert math.isnan(hard.ratio)
    assert math.isnan(clean.standard_error)
    assert found.markdown().splitlines()[-1].split("|")[3:5] == [" " * 16, " " * 16]
