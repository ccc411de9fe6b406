"""Figures of docs/gym-tasks.md."""

from __future__ import annotations

import json

from pixelbrax_gym.bench.tables import table
from pixelbrax_jax.tasks import GYM_TASKS
from tests.physics.gym.measure import RESULTS


def tasks() -> str:
    """All tasks, and how far they are from Gymnasium's, in Markdown."""
    kept = json.loads(RESULTS.read_text("utf-8"))["tasks"]
    lines = []
    for name, row in GYM_TASKS.items():
        step = kept[name]["control_step"]
        shown = [f"{step[part]:.0e}" for part in ("observation", "reward")]
        lines.append([f"`{row.gymnasium_id}`", f"`{name}`", row.summary, row.time_limit, *shown])
    heads = ("Gymnasium id", "in JAX", "goal and end", "time limit", "observation", "reward")
    return table(heads, lines)


FIGURES = {"tasks": tasks}
