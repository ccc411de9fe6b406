"""Figures of docs/gym-tasks.md."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

from pixelbrax_gym.bench.tables import table
from pixelbrax_jax.tasks import GYM_TASKS
from tests.physics.gym.measure import RESULTS

DOCS = Path(__file__).parents[2] / "docs"


def tasks() -> str:
    """All tasks, and how far they are from Gymnasium's, in Markdown."""
    kept = json.loads(RESULTS.read_text("utf-8"))["tasks"]
    lines = []
    for name, row in GYM_TASKS.items():
        step = kept[name]["control_step"]
        shown = [f"{step[part]:.0e}" for part in ("observation", "reward")]
        lines.append([f"`{name}`", row.summary, row.time_limit, *shown])
    return table(("name", "goal and end", "time limit", "observation off by", "reward"), lines)


def random() -> str:
    """Return of random actions in HalfCheetah."""
    kept = json.loads((DOCS / "results" / "untrained.json").read_text("utf-8"))
    return f"{kept['gym_halfcheetah']['random']['return']:,.0f}"


def learned(minutes: float = float("inf")) -> str:
    """Return of PPO's run in HalfCheetah after minutes of training, by default at the end."""
    entry = json.loads((DOCS / "leaderboard" / "ppo-gym_halfcheetah-0.json").read_text("utf-8"))
    reached = zip(entry["seconds"], entry["return"], strict=True)
    return f"{[value for at, value in reached if at <= 60 * minutes][-1]:,.0f}"


FIGURES = {
    "tasks": tasks,
    "random": random,
    "halfcheetah": learned,
    "half": partial(learned, 15.0),
}
