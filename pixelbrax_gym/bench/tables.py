"""Format outcomes as tables in Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

from pixelbrax_jax.tasks import TASKS

Row = dict[str, Any]
"""Stored outcome of a case: ``group``, ``measure``, ``arguments``, ``status``, ``values``, ..."""


def table(heads: Iterable[str], lines: Iterable[Iterable[Any]]) -> str:
    """Return a Markdown table with padded columns."""
    rows = [[str(cell) for cell in row] for row in (list(heads), *lines)]
    widths = [max(3, *map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    padded = (map(str.ljust, row, widths) for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)


def number(value: float | None) -> str:
    """Format with three significant digits and thousands separators; a hyphen if unknown."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(0, digits)}f}"


def title(task: str) -> str:
    """Return a task's name in its Gymnasium id."""
    return TASKS[task].gymnasium_id.removeprefix("PixelBrax/").removesuffix("-v0")


def succeeded(rows: list[Row]) -> list[Row]:
    """Return the outcomes that have values."""
    return [row for row in rows if row["status"] == "ok"]


def find(rows: list[Row], measure: str, **arguments: Any) -> Row | None:
    """Return the first outcome of a measure whose arguments include these."""
    for row in rows:
        if row["measure"] == measure and arguments.items() <= row["arguments"].items():
            return row
    return None


def value(row: Row | None, name: str) -> Any:
    """Return a value of an outcome; None if it is missing."""
    return row["values"][name] if row is not None and row["status"] == "ok" else None


def cell(row: Row | None, name: str) -> str:
    """Format a value of an outcome, or the reason why it is missing."""
    if row is None:
        return "not yet"
    return number(row["values"][name]) if row["status"] == "ok" else str(row["status"])


def ratio(above: float | None, below: float | None) -> str:
    """Format a quotient; a hyphen if a value is unknown."""
    return number(above / below) if above and below else "-"


def renderer(rows: list[Row]) -> str:
    """Return the table of the renderer's frames per second."""

    def line(row: Row) -> list[str]:
        options = {k: v for k, v in row["arguments"].items() if k not in ("task", "num_envs")}
        return [
            ", ".join(f"{k}={v}" for k, v in options.items()) or "default",
            str(row["arguments"]["num_envs"]),
            number(row["values"]["frames_per_second"]),
            number(row["values"]["compile_seconds"]),
        ]

    heads = ("Ant", "environments", "frames/s", "compilation, s")
    return table(heads, map(line, succeeded(rows)))


def environments(rows: list[Row]) -> str:
    """Return the table of steps per second with and without pixels."""
    lines = []
    for task in dict.fromkeys(row["arguments"]["task"] for row in rows):
        of_task = [row for row in rows if row["arguments"]["task"] == task]
        for num_envs in sorted({row["arguments"]["num_envs"] for row in of_task}):
            where = {"num_envs": num_envs}
            state = find(of_task, "throughput.scan", **where, obs_mode="state")
            pixels = find(of_task, "throughput.scan", **where, obs_mode="pixels")
            frames = find(of_task, "throughput.renderer", **where)
            both = (value(row, "steps_per_second") for row in (pixels, state))
            held = value(pixels, "bytes_per_env")
            peak = (pixels or {}).get("peak_bytes") or {"device": None, "host": None}
            lines.append(
                [
                    title(task),
                    num_envs,
                    cell(pixels, "steps_per_second"),
                    cell(state, "steps_per_second"),
                    ratio(*both),
                    cell(frames, "frames_per_second") if frames else "-",
                    cell(pixels, "compile_seconds"),
                    ratio(held, 1e3),
                    ratio(peak["device"] or peak["host"], 1e9),
                ]
            )
    heads = (
        "task",
        "environments",
        "pixels, steps/s",
        "state only",
        "pixels / state",
        "renderer, frames/s",
        "compilation, s",
        "kB / environment",
        "peak memory, GB",
    )
    return table(heads, lines)


def interleaved(*columns: str) -> Callable[[list[Row]], str]:
    """Return a function that formats a comparison with columns for these arguments or values."""

    def draw(rows: list[Row]) -> str:
        lines = [
            [
                title(row["arguments"]["task"]),
                *({**row["arguments"], **values}[column] for column in columns),
                number(values["steps_per_second"]),
                f"{values['ratio']:.2f}",
                " to ".join(f"{bound:.2f}" for bound in values["interval"]),
                values["runs"],
            ]
            for row in succeeded(rows)
            for values in row["values"]
        ]
        names = {"num_envs": "environments", "autoreset_mode": "autoreset"}
        heads = ("task", *(names.get(column, column) for column in columns))
        return table((*heads, "steps/s", "ratio", "interval", "rounds"), lines)

    return draw
