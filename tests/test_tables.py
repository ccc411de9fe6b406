"""The tables of the documentation are those of the code."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from pathlib import Path

import gymnasium

import pixelbrax_gym
from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.benchmarks import task_table
from tests.benchmarks.pages import drawn

ROOT = Path(__file__).parents[1]


def table(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading row, row by row."""
    lines = (ROOT / page).read_text("utf-8").split("\n")
    start = next(i for i, line in enumerate(lines) if line.startswith(heading))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def code(cell: str) -> list[str]:
    return re.findall(r"`([^`]*)`", cell)


def test_every_option_is_listed_with_its_default():
    listed = {}
    for names, defaults, _ in table("docs/options.md", "| option | default | meaning"):
        listed |= dict(zip(code(names), code(defaults), strict=True))
    options = {f.name: f.default for f in fields(EnvConfig) if f.name != "task"}
    assert listed == {name: repr(value).replace("'", '"') for name, value in options.items()}


def test_every_task_is_listed():
    assert drawn(task_table.PAGE, "tasks") == task_table.tasks()
    for name, task in BRAX_TASKS.items():
        assert gymnasium.spec(task.gymnasium_id).kwargs == {"task": name}


def test_every_task_has_its_animation():
    shown = re.findall(
        r"!\[(\w+)\]\((images/tasks/\w+\.gif)\)", (ROOT / "docs/tasks.md").read_text()
    )
    assert shown == [(name, f"images/tasks/{name}.gif") for name in BRAX_TASKS]
    for _, path in shown:
        assert (ROOT / "docs" / path).is_file()


def test_the_options_of_adapters_are_listed():
    adapters = [
        pixelbrax_gym.GymnasiumEnv,
        pixelbrax_gym.GymnasiumVectorEnv,
        pixelbrax_gym.TorchRLEnv,
        pixelbrax_gym.SB3VecEnv,
    ]
    taken = [
        set(inspect.signature(adapter.__init__).parameters) - {"self", "task", "options"}
        for adapter in adapters
    ]
    listed: list[set[str]] = [set() for _ in adapters]
    for names, *cells, _ in table("docs/options.md", "| option | Gymnasium `make` |"):
        for options, cell in zip(listed, cells, strict=True):
            options |= set(code(names)) if cell == "yes" else set()
    assert listed == taken
