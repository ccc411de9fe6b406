"""Entries of a leaderboard, made from training runs, and its tables.

An entry is a JSON file: what was trained, on which processor, and the returns of the mean action
over frames and over seconds of training.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import trim_mean

from pixelbrax_gym.bench.tables import table
from pixelbrax_gym.cli._agents import MAY_DIFFER
from pixelbrax_jax.agents.runner.checkpoint import read_about
from pixelbrax_jax.agents.runner.metrics import read_metrics
from pixelbrax_jax.paths import in_home, make_folder

MINUTES = (5, 15, 30)
FRAMES = (100_000, 500_000, 1_000_000)
PUBLISHED = "published.json"
"""File beside the entries with returns at frames that others published, by agent and task."""

Entry = dict[str, Any]

_NEEDED = {"task", "agent", "seed", "config", "frames", "seconds", "return"}


def entry(folder: str | Path, agent: str | None = None) -> Entry:
    """Read the entry of a run from its output folder; ``agent`` names it, default its algorithm.

    Seconds exclude evaluations and the compilation at the start, which is the first iteration's
    time minus the second's. They include the compilation of a resumed run.
    """
    folder = Path(folder)
    about = read_about(folder / "checkpoints")
    config = about["config"]
    if config["seeds"] > 1:
        raise ValueError(f"{folder} has seeds={config['seeds']} in one program; an entry has one.")
    for name in ("distractors", "dynamics"):
        if value := config.get(name):
            raise ValueError(
                f"{folder} trained with {name}={value!r}; the leaderboard has runs without."
            )
    if config.get("num_starts"):
        raise ValueError(
            f"{folder} trained with num_starts={config['num_starts']}, so it was evaluated from "
            "initial states that it knew; the leaderboard has runs with num_starts=0."
        )
    records = read_metrics(folder / "metrics.jsonl")
    evaluations = [record for record in records if "eval/clean/return" in record]
    if len(evaluations) < 2:
        raise ValueError(
            f"{folder} has {len(evaluations)} evaluations; train with --num-evals 20 or more."
        )
    steps, seconds, compilation = _clock(records)
    at = [record["steps"] for record in evaluations]
    return {
        "task": config["task"],
        "agent": agent or about["algorithm"],
        "algorithm": about["algorithm"],
        "seed": config["seed"],
        "versions": about["versions"],
        "config": config,
        "compile_seconds": round(compilation, 1),
        "frames": at,
        "seconds": [round(float(x), 1) for x in np.interp(at, steps, seconds)],
        "return": [round(record["eval/clean/return"], 2) for record in evaluations],
        "standard_error": [
            round(record.get("eval/clean/standard_error", 0.0), 2) for record in evaluations
        ],
    }


def _clock(records: Iterable[Mapping[str, float]]) -> tuple[list[float], list[float], float]:
    """Return steps, seconds of training up to each, and seconds of compilation."""
    training = [record for record in records if "speed/steps_per_second" in record]
    if len(training) < 2:
        raise ValueError("the run has too few records; train with --log-training-metrics.")
    steps = [0.0, *(record["steps"] for record in training)]
    rates = [record["speed/steps_per_second"] for record in training]
    durations = list(np.diff(steps) / rates)
    usual = durations[1] * steps[1] / (steps[2] - steps[1])
    compilation = max(0.0, durations[0] - usual)
    durations[0] -= compilation
    return steps, [0.0, *np.cumsum(durations)], compilation


def add(of: Entry, folder: str | Path) -> Path:
    """Write an entry into a folder without another entry of its name; return the file."""
    board = make_folder("--folder", folder)
    entries = read(board)
    agent, task = re.sub(r"[\W_]", "-", of["agent"].lower()), re.sub(r"\W", "-", of["task"])
    path = board / f"{agent}-{task}-{of['seed']}.json"
    there = _read_json(path) if path.exists() else of
    if any(there.get(name) != of[name] for name in ("task", "agent", "seed")):
        raise FileExistsError(
            f"{path} belongs to agent {there.get('agent')!r} on task {there.get('task')!r}: name "
            "the agent otherwise with --agent."
        )
    if there != of:
        raise FileExistsError(
            f"{path} is another run of this agent, task and seed: delete it, or name the agent "
            "otherwise with --agent."
        )
    for other in entries:
        if (other["task"], other["agent"]) == (of["task"], of["agent"]):
            _check_same_settings(of, other)
    path.write_text(json.dumps(of) + "\n", "utf-8")
    return path


def _check_same_settings(of: Entry, other: Entry) -> None:
    """Raise a ValueError if two entries cannot be seeds of one agent."""
    here, there = ({"algorithm": one.get("algorithm"), **one["config"]} for one in (of, other))
    # Releases have different settings.
    for setting in sorted(here.keys() & there.keys() - {"seed", *MAY_DIFFER}):
        if here[setting] != there[setting]:
            raise ValueError(
                f"runs of one agent differ in seeds alone, but {setting} is {here[setting]!r} with "
                f"seed {of['seed']} and {there[setting]!r} with seed {other['seed']} of the "
                "leaderboard: name the agent otherwise with --agent."
            )


def read(folder: str | Path) -> list[Entry]:
    """Read the entries of a folder; a ValueError names what is not a folder, or not an entry."""
    board = in_home(folder)
    if not board.is_dir():
        raise ValueError(f"--folder must be a folder with entries, and {board} is none.")
    entries = []
    for file in sorted(board.glob("*.json")):
        if file.name == PUBLISHED:
            continue
        found = _read_json(file)
        if not (found.keys() >= _NEEDED and isinstance(found["config"], dict) and found["frames"]):
            raise ValueError(f"{file} of --folder is not an entry of a leaderboard; move it away.")
        entries.append(found)
    return entries


def _read_json(file: Path) -> dict[str, Any]:
    """Read a file; return nothing if it is not JSON of an object."""
    try:
        found = json.loads(file.read_text("utf-8"))
    except (ValueError, IsADirectoryError):
        return {}
    return found if isinstance(found, dict) else {}


def read_by_agent(folder: str | Path) -> dict[tuple[str, str], list[Entry]]:
    """Read the entries of each task and agent."""
    groups: dict[tuple[str, str], list[Entry]] = {}
    for one in read(folder):
        groups.setdefault((one["task"], one["agent"]), []).append(one)
    return groups


def read_published(folder: str | Path) -> dict[str, Any]:
    """Read published returns by agent; none without the file."""
    file = in_home(folder) / PUBLISHED
    if not file.exists():
        return {}
    agents = _read_json(file).get("agents")
    if not isinstance(agents, dict):
        raise ValueError(f"{file} of --folder has no 'agents' of published returns; move it away.")
    return agents


def return_at(of: Entry, clock: str, when: float) -> float:
    """Return an entry's return at a number of ``"frames"`` or ``"seconds"``, or NaN.

    Returns are interpolated between evaluations, and NaN before the first one. After the end of
    the run they are NaN for more frames, and the last return for later times.
    """
    times = of[clock]
    # Iterations end near round numbers of frames.
    if when < 0.98 * times[0] or (clock == "frames" and when > 1.02 * times[-1]):
        return math.nan
    return float(np.interp(when, times, of["return"]))


def page(folder: str | Path) -> str:
    """Return the table of a folder's entries in Markdown, a row for each task and agent."""
    groups, published = read_by_agent(folder), read_published(folder)
    heads = ["task", "agent", "seeds", *(f"{minutes} min" for minutes in MINUTES)]
    heads += [f"{frames // 1000:,}k frames" for frames in FRAMES] + ["end"]
    lines = []
    for task in sorted({task for task, _ in groups}):
        for (_, agent), runs in sorted(item for item in groups.items() if item[0][0] == task):
            times = [_shown(runs, "seconds", 60.0 * minutes) for minutes in MINUTES]
            counts = [_shown(runs, "frames", frames) for frames in FRAMES]
            lines.append([f"`{task}`", agent, len(runs), *times, *counts, _end(runs)])
        for agent, about in published.items():
            if found := about["returns"].get(task):
                counts = [f"{found[str(n)]:.0f}" if str(n) in found else "" for n in FRAMES]
                lines.append(
                    [f"`{task}`", f"{agent}, published", about["seeds"], "", "", "", *counts, ""]
                )
    return table(heads, lines)


def _end(runs: list[Entry]) -> str:
    """Format the last returns and the number of frames."""
    ends = [run["frames"][-1] / 1e6 for run in runs]
    frames = dict.fromkeys(f"{end:.1f}" for end in (min(ends), max(ends)))
    return f"{middle([run['return'][-1] for run in runs])} at {' to '.join(frames)}M"


def _shown(runs: list[Entry], clock: str, when: float) -> str:
    found = [return_at(run, clock, when) for run in runs]
    # A mean of only some runs is not comparable with the other columns.
    return "" if any(map(math.isnan, found)) else middle(found)


def middle(scores: list[float]) -> str:
    """Format the interquartile mean, and the range of several scores."""
    # As in rliable (arXiv 2108.13264).
    mean = f"{trim_mean(scores, 0.25):.0f}"
    if len(scores) == 1:
        return mean
    return f"{mean} ({min(scores):.0f} to {max(scores):.0f})"
