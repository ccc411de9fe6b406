"""Trains agents with and without distractors, and plays suites of levels with them.

    python -m tests.benchmarks.generalisation --seeds 1              all of one seed, half a day
    python -m tests.benchmarks.generalisation --seeds 1 walker_walk  those with this in their names

Returns go to docs/benchmarks/generalisation; seeds that are there are neither trained nor played
again. A stopped training goes on. ``python -m tests.benchmarks.figures`` then writes the tables.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from textwrap import indent

from pixelbrax_gym.bench.tables import table
from pixelbrax_gym.generalisation.scores import RETURNS, SHEET, Row, Scores
from pixelbrax_jax.tasks import DMC_TASKS
from tests.benchmarks.experiments import DOCS, EPISODES, REVISION, run

KEPT = DOCS / "benchmarks" / "generalisation"
SUITES = ("dmcgb2", "axes")
AGENT = "drqv2"
"""With its preset `cpu`."""
TASKS = (
    "dmc_cartpole_swingup",
    "dmc_finger_spin",
    "dmc_walker_stand",
    "dmc_walker_walk",
    "halfcheetah",
)
TRAININGS = {
    "no-shifts": ("--random-shift", "0"),
    "shifts": (),
    "color-easy": ("--distractors", "color-easy"),
    "video-easy": ("--distractors", "video-easy", "--clips", "procedural"),
}
"""Options by what the agent is trained with."""


def suites_of(task: str) -> tuple[str, ...]:
    """The suites to play; DMC-GB2 has levels for tasks of DM Control alone."""
    return tuple(suite for suite in SUITES if suite != "dmcgb2" or task in DMC_TASKS)


def kept_at(task: str, training: str, suite: str) -> Path:
    """The file with the returns of all seeds."""
    return KEPT / f"{task}-{training}-{suite}.json"


def kept(task: str, training: str, suite: str) -> Scores | None:
    """The returns of all seeds, if there are any."""
    path = kept_at(task, training, suite)
    return Scores(**json.loads(path.read_text("utf-8"))) if path.exists() else None


def train(task: str, training: str, seed: int, folder: Path) -> int:
    """Train an agent, or finish its training; the exit status is that of ``run``."""
    command = ["train", AGENT, "--preset", "cpu", "--task", task, "--seed", str(seed)]
    command += ["--eval-episodes", str(EPISODES), "--num-evals", "1", *TRAININGS[training]]
    return run(command, folder, math.inf)


def play(task: str, training: str, suite: str, seed: int, run: Path) -> int:
    """Play the levels with a run, add its returns to those of other seeds; return the status."""
    before, folder = kept(task, training, suite), run.parent / f"{run.name}-{suite}"
    command = ["nice", "-n", "19", sys.executable, "-m", "pixelbrax_gym.cli", "evaluate"]
    command += [str(run), "--suite", suite, "--clips", "procedural"]
    command += ["--episodes", str(before.options["episodes"] if before else EPISODES)]
    command += ["--output-dir", str(folder)]
    if status := subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode:
        return status
    found = json.loads((folder / RETURNS).read_text("utf-8"))
    path = kept_at(task, training, suite)
    if before and before.options != found["options"]:
        print(f"{path} is of other options; move it away to play all seeds anew", file=sys.stderr)
        return 1
    (played,) = found["returns"].values()
    found["returns"] = (before.returns if before else {}) | {f"seed {seed}": played}
    KEPT.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(found) + "\n", "utf-8")
    shutil.copyfile(folder / SHEET, KEPT / f"{task}-{suite}.png")
    return 0


def columns(task: str, suite: str) -> dict[str, list[Row]]:
    """Rows of the suite by training, with the number of seeds in the name."""
    scores = {name: found for name in TRAININGS if (found := kept(task, name, suite))}
    return {f"{name} ({len(found.returns)})": found.rows() for name, found in scores.items()}


def summary() -> str:
    """A row for each training: clean, and the last rows of both suites, in Markdown."""
    lines = []
    for task, training in product(TASKS, TRAININGS):
        scores = [kept(task, training, suite) for suite in SUITES]
        found = [suite.rows() if suite else [] for suite in scores]
        if clean := next((rows[0] for rows in found if rows), None):
            disturbed = [_cell(rows[-1]) if rows else "" for rows in found]
            ends = [clean, *(rows[-1] if rows else None for rows in found)]
            success = ", ".join(f"{100 * row.success:.0f}" if row else "-" for row in ends)
            seeds = str(clean.runs)
            lines.append([f"`{task}`", training, seeds, _cell(clean), *disturbed, success])
    return table(["task", "trained with", "seeds", "clean", "DMC-GB2", "axes", "success, %"], lines)


def example() -> str:
    """The first and the last rows of the table that `pixelbrax evaluate` prints of one seed."""
    found = kept("dmc_walker_walk", "shifts", "dmcgb2")
    assert found is not None, "its returns are in this repository"
    one = replace(found, returns={"seed 0": found.returns["seed 0"]})
    head, rule, *lines = one.markdown().splitlines()
    gap = "| ..." + re.sub(r"[^|]", " ", head)[5:]
    return "\n".join([head, rule, *lines[:3], gap, lines[-1]])


def levels_page() -> str:
    """A table of DMC-GB2 for each task, a column for each training, in Markdown."""

    def rows_of(task: str, found: dict[str, list[Row]]) -> tuple[list[str], list[list[str]]]:
        lines = [[rows[0].level, *map(_cell, rows)] for rows in zip(*found.values(), strict=True)]
        heads = ["level", *found]
        for name, returns in published(task).items():
            heads.append(name)
            lines = [[*line, returns.get(line[0], "")] for line in lines]
        return heads, lines

    return _tables("dmcgb2", rows_of)


def axes_page() -> str:
    """A table of all axes for each task, a column for each training; sizes are in one cell."""

    def rows_of(_: str, found: dict[str, list[Row]]) -> tuple[list[str], list[list[str]]]:
        axes: dict[str, list[list[str]]] = {}
        for rows in zip(*found.values(), strict=True):
            axis = rows[0].level.rstrip("-123").replace("-", " ")
            axes.setdefault(axis, []).append([f"{row.mean:.0f}" for row in rows])
        lines = [[axis, *map(", ".join, zip(*sizes, strict=True))] for axis, sizes in axes.items()]
        return ["axis", *found], lines

    return _tables("axes", rows_of)


def _tables(
    suite: str,
    rows_of: Callable[[str, dict[str, list[Row]]], tuple[list[str], list[list[str]]]],
) -> str:
    """A tab for each task with returns; ``rows_of`` makes head and rows of its table."""
    found = {task: columns(task, suite) for task in TASKS}
    return "\n\n".join(
        f'=== "{task}"\n\n{indent(table(*rows_of(task, scores)), "    ")}'
        for task, scores in found.items()
        if scores
    )


def published(task: str) -> dict[str, dict[str, str]]:
    """Published means and standard deviations of a task, by agent and level."""
    kept = json.loads((KEPT / "published.json").read_text("utf-8"))
    return {
        f"{agent}, published": {level: f"{mean} ± {over}" for level, (mean, over) in levels.items()}
        for agent, levels in kept["returns"].get(task, {}).items()
    }


def _cell(row: Row) -> str:
    if row.runs > 1:
        return f"{row.mean:.0f} ({row.low:.0f} to {row.high:.0f})"
    spread = "" if math.isnan(row.standard_error) else f" ± {row.standard_error:.0f}"
    return f"{row.mean:.0f}{spread}"


def largest_error(*tasks: str) -> str:
    """The largest standard error of a mean on one of the axes."""
    found = [kept(task, training, "axes") for task in tasks for training in TRAININGS]
    errors = [row.standard_error for scores in found if scores for row in scores.rows()]
    return f"{max(error for error in errors if not math.isnan(error)):.0f}"


FIGURES: dict[str, Callable[[], str]] = {
    "summary": summary,
    "dmcgb2": levels_page,
    "axes": axes_page,
    "axes-error": partial(largest_error, *(task for task in TASKS if task in DMC_TASKS)),
    "axes-error-halfcheetah": partial(largest_error, "halfcheetah"),
}


def main() -> int:
    """Run the command; the exit status is 1 if a training or an evaluation failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", nargs="?", default="", help="part of the names")
    parser.add_argument("--seeds", type=int, default=3, help="how many of each")
    parser.add_argument("--output-dir", type=Path, default=Path("runs/generalisation"))
    options = parser.parse_args()
    chosen = [both for both in product(TASKS, TRAININGS) if options.name in "-".join(both)]
    if not chosen:
        parser.error(f"no agent has {options.name!r} in its name")
    failed = []
    for (task, training), seed in product(chosen, range(options.seeds)):
        made = options.output_dir / f"revision-{REVISION}" / f"{task}-{training}" / str(seed)
        plays = {
            f"{suite} of {made}": partial(play, task, training, suite, seed, made)
            for suite in suites_of(task)
            if not (before := kept(task, training, suite)) or f"seed {seed}" not in before.returns
        }
        if not plays:
            continue
        training_first = {str(made): partial(train, task, training, seed, made)}
        for name, job in (training_first | plays).items():
            status = job()
            if status > 128 or status < 0:
                print(f"stopped in {name}; the same command goes on", file=sys.stderr)
                return status
            if status:
                failed.append(name)
                if name in training_first:
                    break
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
