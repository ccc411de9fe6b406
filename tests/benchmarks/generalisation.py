"""Trains agents with and without distractors, and plays suites with them.

    python -m tests.benchmarks.generalisation              all, an hour or more for each seed
    python -m tests.benchmarks.generalisation ball_in_cup  those with this in their names
    python -m tests.benchmarks.generalisation --seeds 1 --suite dmcgb2

What is trained and played already is not repeated. Returns go to docs/benchmarks/generalisation,
tables to docs/benchmarks/generalisation.md.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

from pixelbrax_gym.bench.tables import table
from pixelbrax_gym.generalisation.scores import RETURNS, SHEET, Row, Scores
from pixelbrax_jax.tasks import DMC_TASKS
from tests.benchmarks.experiments import DOCS, EPISODES, REVISION, run

KEPT = DOCS / "benchmarks" / "generalisation"
TASKS = {
    "dmc_ball_in_cup_catch": "ppo",
    "dmc_cartpole_swingup": "drqv2",
    "dmc_finger_spin": "drqv2",
    "dmc_walker_walk": "drqv2",
    "halfcheetah": "ppo",
}
"""The agent of each task, with its preset `cpu`."""
SHIFTS = {"ppo": ("--random-shift", "2"), "drqv2": ()}
"""DrQ-v2 always shifts images."""
VARIANTS = {
    "clean": (),
    "shifts": None,
    "color-easy": ("--distractors", "color-easy"),
    "video-easy": ("--distractors", "video-easy", "--clips", "procedural"),
}
"""What agents are trained with; None stands for ``SHIFTS``."""
SUITES = ("dmcgb2", "axes")


def variants(task: str) -> dict[str, tuple[str, ...]]:
    """Options of the trainings of a task, by name."""
    found = {name: SHIFTS[TASKS[task]] if line is None else line for name, line in VARIANTS.items()}
    if found["shifts"] == found["clean"]:
        del found["clean"]
    return found


def kept_at(suite: str, task: str, variant: str) -> Path:
    """The file with the returns of all seeds."""
    return KEPT / f"{suite}-{task}-{variant}.json"


def trained(task: str, variant: str, seed: int, folder: Path) -> Path | None:
    """Train an agent, or finish its training; return its folder, None if it failed."""
    agent = TASKS[task]
    made = folder / f"revision-{REVISION}" / f"{agent}-{task}-{variant}-{seed}"
    command = ["train", agent, "--preset", "cpu", "--task", task, "--seed", str(seed)]
    command += ["--eval-episodes", str(EPISODES), "--num-evals", "1", *variants(task)[variant]]
    if not (made / "policy.jax").exists() and run(command, made, math.inf):
        return None
    return made


def play(suite: str, task: str, variant: str, runs: list[Path], folder: Path) -> None:
    """Play the levels that have not been played."""
    played = folder / f"revision-{REVISION}" / f"{suite}-{task}-{variant}"
    command = [sys.executable, "-m", "pixelbrax_gym.cli", "evaluate", *map(str, runs)]
    command += ["--suite", suite, "--clips", "procedural", "--output-dir", str(played)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    KEPT.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(played / RETURNS, kept_at(suite, task, variant))
    shutil.copyfile(played / SHEET, KEPT / f"{suite}-{task}.png")


def rows(suite: str, task: str) -> dict[str, list[Row]]:
    """Rows of a suite's table, by what the agents were trained with."""
    found = {}
    for variant in variants(task):
        if (path := kept_at(suite, task, variant)).exists():
            kept = json.loads(path.read_text("utf-8"))
            found[variant] = Scores(**kept).rows()
    return found


def page_of(suite: str) -> str:
    """A table for each task, a column for each training, in Markdown."""
    parts = []
    for task, agent in TASKS.items():
        of_variants = rows(suite, task)
        if not of_variants:
            continue
        first = next(iter(of_variants.values()))
        columns = [{row.level: row for row in found} for found in of_variants.values()]
        lines = [
            [row.level, *(_cell(column[row.level]) for column in columns)]
            for row in first
            if all(row.level in column for column in columns)
        ]
        seeds = min(found[0].runs for found in of_variants.values())
        title = f"**`{task}`**, {agent}, {seeds} seed{'s' if seeds > 1 else ''}"
        parts.append(f"{title}\n\n{table(('level', *of_variants), lines)}")
    return "\n\n".join(parts) or "Not measured yet."


def _cell(row: Row) -> str:
    spread = "" if math.isnan(row.standard_error) else f" ± {row.standard_error:.0f}"
    return f"{row.mean:.0f}{spread}"


FIGURES = {"dmcgb2": partial(page_of, "dmcgb2")}


def main() -> int:
    """Run the command; the exit status is 1 if a training failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", nargs="?", default="", help="part of the names")
    parser.add_argument("--seeds", type=int, default=3, help="how many of each")
    parser.add_argument("--suite", choices=SUITES, help="the only suite to play")
    parser.add_argument("--output-dir", type=Path, default=Path("runs/generalisation"))
    options = parser.parse_args()
    chosen = [
        (task, variant)
        for task in TASKS
        for variant in variants(task)
        if options.name in f"{task}-{variant}"
    ]
    if not chosen:
        parser.error(f"no agent has {options.name!r} in its name")
    failed = False
    for task, variant in chosen:
        runs = [trained(task, variant, i, options.output_dir) for i in range(options.seeds)]
        if missing := runs.count(None):
            print(f"{task}, {variant}: {missing} trainings did not end", file=sys.stderr)
            failed = True
            continue
        for suite in [options.suite] if options.suite else SUITES:
            # DMC-GB2 has no levels for tasks of others.
            if suite == "dmcgb2" and task not in DMC_TASKS:
                continue
            play(suite, task, variant, [made for made in runs if made], options.output_dir)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
