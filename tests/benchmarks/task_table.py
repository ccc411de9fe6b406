"""Draws the table of docs/tasks.md from the rows of Brax's tasks.

python -m tests.benchmarks.task_table
"""

from __future__ import annotations

from pathlib import Path

from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.benchmarks.pages import redraw

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"


def tasks() -> str:
    """All of Brax's tasks, in Markdown."""
    rows = [("Gymnasium id", "in JAX", "actions", "backend", "goal and end"), ("---",) * 5]
    for name, row in BRAX_TASKS.items():
        actions = str(make_physics(name).action_size)
        rows.append(
            (f"`{row.gymnasium_id}`", f"`{name}`", actions, row.default_backend, row.summary)
        )
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


if __name__ == "__main__":
    redraw(PAGE, {"tasks": tasks()})
