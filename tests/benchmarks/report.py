"""Results -> a page of tables for the documentation, and plots."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import matplotlib

from tests.benchmarks.cases import BATCHES, GROUPS, TASKS

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Row = dict[str, Any]


def write(file: Path) -> None:
    """Writes the page and the plots that belong to the results in ``file``."""
    report = json.loads(file.read_text())
    rows = list(report["cases"].values())
    plotted = plot(rows, file.with_suffix(".png"))
    file.with_suffix(".md").write_text(page(report, rows, file, plotted))


def page(report: Row, rows: list[Row], file: Path, plotted: bool) -> str:
    """The page, in Markdown."""
    machine = report["machine"]
    versions = ", ".join(f"{name} {v}" for name, v in machine["versions"].items() if v)
    parts = [
        f"# Measurements: {machine['platform']}",
        "Written by `pixelbrax bench`; [Performance](../performance.md) says what it means.",
        f"{machine['device']} ({machine['processor']}, {machine['cores']} cores), "
        f"{machine['system']}, Python {machine['python']}; {versions}. "
        f"XLA_FLAGS: `{machine['xla_flags'] or 'none'}`.",
    ]
    if plotted:
        parts.append(f"![Steps per second over the number of environments]({file.stem}.png)")
    for group in GROUPS:
        of_group = [row for row in rows if row["group"] == group]
        if of_group:
            dates = sorted({row["date"][:10] for row in of_group})
            command = f"`pixelbrax bench --only {group}`, {' and '.join(dates)}."
            parts += [f"## {group.capitalize()}", command, TABLES[group](of_group)]
    missing = [row for row in rows if row["status"] != "ok"]
    if missing:
        lines = [f"| {_name(row)} | {row['status']} | {row['why'][:160]} |" for row in missing]
        parts += ["## Not measured", "\n".join(["| case | | why |", "|---|---|---|", *lines])]
    return "\n\n".join(parts) + "\n"


def _name(row: Row) -> str:
    return " ".join([row["measure"], *(f"{k}={v}" for k, v in row["arguments"].items())])


def _table(heads: Iterable[str], lines: Iterable[Iterable[Any]]) -> str:
    heads = list(heads)
    rows = [heads, ["---"] * len(heads), *([str(cell) for cell in line] for line in lines)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def number(value: float | None) -> str:
    """Three significant digits, thousands apart."""
    if value is None or value != value:
        return "-"
    if value >= 1000:
        digits = max(0, len(str(int(value))) - 3)
        return f"{round(value, -digits):,.0f}"
    return f"{value:.3g}"


def _ok(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["status"] == "ok"]


def _renderer(rows: list[Row]) -> str:
    def line(row: Row) -> list[str]:
        values, options = row["values"], dict(row["arguments"])
        frame, num_envs = values["per_frame"], options.pop("num_envs")
        options.pop("task")
        return [
            ", ".join(f"{k}={v}" for k, v in options.items()) or "default",
            str(num_envs),
            number(values["frames_per_second"]),
            number(values["compile_seconds"]),
            f"{frame['temporary_bytes'] / frame['output_bytes']:.2f}",
            number(frame["operations"] / 1e6),
        ]

    heads = (
        "Ant",
        "environments",
        "frames/s",
        "compilation, s",
        "temporaries / output",
        "million operations / frame",
    )
    return _table(heads, map(line, _ok(rows)))


def _of(rows: list[Row], measure: str, **arguments: Any) -> Row | None:
    for row in rows:
        if row["measure"] == measure and arguments.items() <= row["arguments"].items():
            return row
    return None


def _cell(row: Row | None, name: str) -> str:
    if row is None:
        return "not yet"
    return number(row["values"][name]) if row["status"] == "ok" else row["status"]


def _environments(rows: list[Row]) -> str:
    lines = []
    for task, title in TASKS.items():
        for num_envs in BATCHES:
            where = {"task": task, "num_envs": num_envs}
            state = _of(rows, "throughput.scan", **where, obs_mode="state")
            pixels = _of(rows, "throughput.scan", **where, obs_mode="pixels")
            frames = _of(rows, "throughput.renderer", **where)
            if not (state or pixels or frames):
                continue
            both = state and pixels and state["status"] == pixels["status"] == "ok"
            ratio = (
                pixels["values"]["steps_per_second"] / state["values"]["steps_per_second"]
                if both
                else None
            )
            fine = pixels is not None and pixels["status"] == "ok"
            lines.append(
                [
                    title,
                    num_envs,
                    _cell(pixels, "steps_per_second"),
                    _cell(state, "steps_per_second"),
                    number(ratio),
                    _cell(frames, "frames_per_second"),
                    _cell(pixels, "compile_seconds"),
                    number(pixels["values"]["bytes_per_env"] / 1e3) if fine else "",
                    number(pixels["peak_bytes"]["host"] / 1e9) if fine else "",
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
        "peak of the process, GB",
    )
    return _table(heads, lines)


def _sizes(rows: list[Row]) -> str:
    lines = [
        [
            TASKS[row["arguments"]["task"]],
            row["arguments"]["num_envs"],
            number(row["values"]["steps_per_second"]),
        ]
        for row in _ok(rows)
    ]
    return _table(("task", "environments", "64 x 64, steps/s"), lines)


def _turns(what: str, *columns: str) -> Callable[[list[Row]], str]:
    def table(rows: list[Row]) -> str:
        lines = [
            [
                TASKS[row["arguments"]["task"]],
                row["arguments"]["num_envs"],
                *([value["autoreset_mode"]] if what == "door" else []),
                value[what],
                number(value["steps_per_second"]),
                *(f"{value[column]:.2f}" for column in columns),
            ]
            for row in _ok(rows)
            for value in row["values"]
        ]
        mode = ["autoreset"] if what == "door" else []
        titles = (column.replace("_", " ") for column in columns)
        return _table(("task", "environments", *mode, what, "steps/s", *titles), lines)

    return table


def _startup(rows: list[Row]) -> str:
    stages = list(_ok(rows)[0]["values"]["seconds"]) if _ok(rows) else []
    lines = [
        [row["arguments"]["cache"], *(f"{row['values']['seconds'][s]:.1f}" for s in stages)]
        for row in _ok(rows)
    ]
    return _table(("compilation cache", *(f"{stage}, s" for stage in stages)), lines)


def _devices(rows: list[Row]) -> str:
    lines = [
        [
            row["arguments"]["num_devices"],
            row["values"]["num_envs"],
            number(row["values"]["steps_per_second"]),
            number(row["values"]["bytes_on_a_device"] / 1e6),
        ]
        for row in _ok(rows)
    ]
    return _table(("devices", "environments", "steps/s", "MB on a device"), lines)


PAIRS = {"halfcheetah": "cheetah", "walker2d": "walker", "ant": "quadruped", "humanoid": "humanoid"}
"""Our task -> DM Control's of the same class."""


def _peers(rows: list[Row]) -> str:
    lines = []
    for task, domain in PAIRS.items():
        ours = [
            row
            for row in _ok(rows)
            if row["measure"] == "throughput.scan" and row["arguments"]["task"] == task
        ]
        best = max((row["values"]["steps_per_second"] for row in ours), default=None)
        lines.append([f"PixelBrax {TASKS[task]}", "-", number(best), "1"])
        for row in rows:
            here = {task, domain} & set(row["arguments"].values())
            if not here or row["measure"] in ("throughput.scan", *_RENDERERS):
                continue
            values = row.get("values", {})
            speed = values.get("steps_per_second")
            name = row["measure"].removeprefix("peers.").removesuffix("_envs").replace("_", " ")
            count = values.get("processes", values.get("num_envs", ""))
            lines.append(
                [
                    f"{name} {row['arguments'].get('domain', task)}",
                    "alone" if count == 0 else count,
                    number(speed) if speed else row["status"],
                    number(best / speed) if best and speed else "",
                ]
            )
    environments = _table(("steps of", "processes", "steps/s", "PixelBrax is faster by"), lines)
    lines = [
        [
            "MuJoCo Warp" if "warp" in row["measure"] else "PixelBrax",
            row["arguments"]["num_envs"],
            _cell(row, "frames_per_second"),
        ]
        for row in rows
        if row["measure"] in _RENDERERS
    ]
    renderers = _table(("frames of Ant by", "environments", "frames/s"), lines)
    return f"{environments}\n\n{renderers}"


_RENDERERS = ("throughput.renderer", "peers.mujoco_warp_renderer")

TABLES: dict[str, Callable[[list[Row]], str]] = {
    "renderer": _renderer,
    "startup": _startup,
    "doors": _turns("door", "ratio"),
    "distractors": _turns("distractors", "ratio", "ratio_of_fastest"),
    "peers": _peers,
    "devices": _devices,
    "sizes": _sizes,
    "environments": _environments,
}


def plot(rows: list[Row], path: Path) -> bool:
    """Steps per second over the number of environments, one panel a task.

    It is Figure 2 of arXiv 2502.00021 redrawn, with state alone and DM Control beside it.
    """
    rows = _ok(rows)
    if not any(row["group"] == "environments" for row in rows):
        return False
    figure, panels = plt.subplots(
        1, len(TASKS), figsize=(13, 3.6), sharey=True, layout="constrained"
    )
    for panel, (task, title) in zip(panels, TASKS.items(), strict=True):
        for obs_mode, label in (("state", "state only"), ("pixels", "84 x 84 pixels")):
            points = [
                (row["arguments"]["num_envs"], row["values"]["steps_per_second"])
                for row in rows
                if row["group"] == "environments"
                and row["arguments"].get("obs_mode") == obs_mode
                and row["arguments"]["task"] == task
            ]
            panel.loglog(*_columns(points), "o-", label=label)
        points = [
            (max(1, row["values"]["processes"]), row["values"]["steps_per_second"])
            for row in rows
            if row["arguments"].get("domain") == PAIRS[task]
        ]
        if points:
            label = f"DM Control {PAIRS[task]}, pixels"
            panel.loglog(*_columns(points), "s--", label=label)
        panel.set(title=title, xlabel="environments")
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    panels[0].set_ylabel("steps / s")
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return True


def _columns(points: list[tuple[int, float]]) -> tuple[list[int], list[float]]:
    points = sorted(points)
    return [x for x, _ in points], [y for _, y in points]
