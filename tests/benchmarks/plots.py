"""The plots of the documentation: learning curves, and steps per second."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from tests.benchmarks.results import return_at
from tests.benchmarks.tables import title

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {"ppo": "C0", "ppg": "C1", "dcpg": "C2"}
BASELINES = {"random": ("random policy", ":"), "none": ("no action", "--")}
"""Label and line."""


def panels_in_pairs(count: int, **options: Any) -> tuple[Any, list[plt.Axes]]:
    """A figure, and its panels, two in a row."""
    rows, columns = math.ceil(count / 2), min(2, count)
    figure, grid = plt.subplots(
        rows,
        columns,
        figsize=(3.6 * columns, 2.6 * rows + 0.4),
        layout="constrained",
        squeeze=False,
        **options,
    )
    for panel in grid.flat:
        panel.grid(alpha=0.3, which="both")
    for panel in grid.flat[count:]:
        panel.set_visible(False)
    return figure, list(grid.flat[:count])


def learning(panels: dict[str, tuple[list[list[dict]], dict]], path: Path) -> None:
    """Return over steps: thin lines for seeds, a thick one for their mean, a band between them.

    Steps and not minutes, which depend on the machine.
    """
    figure, drawn = panels_in_pairs(len(panels))
    for axes, (name, (groups, untrained)) in zip(drawn, panels.items(), strict=True):
        for seeds in groups:
            _curve(axes, seeds)
        for kind, (label, style) in BASELINES.items():
            level = untrained[kind]["return"]
            axes.axhline(level, color="gray", linestyle=style, label=label)
        axes.set(xlabel="million control steps", ylabel="return in training", title=name)
    legend(figure, drawn, columns=5)
    figure.savefig(path, dpi=130)


def _curve(axes: plt.Axes, seeds: list[dict]) -> None:
    """Draw the runs of one algorithm."""
    algorithm, end = seeds[0]["algorithm"], min(run["steps"][-1] for run in seeds)
    color, grid, window = COLORS[algorithm], np.linspace(0.05 * end, end, 40), 0.1 * end
    lines = np.array([[return_at(run, t, "steps", window) for t in grid] for run in seeds])
    for line in lines:
        axes.plot(grid / 1e6, line, color=color, alpha=0.3, linewidth=0.7)
    if len(seeds) > 1:
        low, high = lines.min(0), lines.max(0)
        axes.fill_between(grid / 1e6, low, high, color=color, alpha=0.2, linewidth=0)
    axes.plot(grid / 1e6, lines.mean(0), color=color, linewidth=1.8, label=algorithm.upper())


def legend(figure: plt.Figure, panels: Iterable[plt.Axes], columns: int) -> None:
    """Show the labels of all panels once each, above them."""
    named: dict[str, Any] = {}
    for panel in panels:
        handles, labels = panel.get_legend_handles_labels()
        named |= zip(labels, handles, strict=True)
    where = {"loc": "outside upper center", "ncols": columns}
    figure.legend(named.values(), named.keys(), fontsize=8, **where)


def leaderboard(entries: list[dict], published: dict[str, dict], path: Path) -> None:
    """Return of the mean action, two panels for each task: over minutes, below it over frames.

    Each agent has a color, each seed a line; dots are published returns.
    """
    tasks, agents = (sorted({one[key] for one in entries}) for key in ("task", "agent"))
    columns = min(4, len(tasks))
    rows = 2 * math.ceil(len(tasks) / columns)
    size = (1 + 2.6 * columns, 2.5 * rows)
    figure, panels = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axes in panels.flat:
        axes.set_visible(False)
    clocks = (("seconds", 60, "minutes of training"), ("frames", 1000, "thousand frames"))
    for place, task in enumerate(tasks):
        for below, (clock, unit, label) in enumerate(clocks):
            axes = panels[place // columns * 2 + below, place % columns]
            for one in entries:
                if one["task"] == task:
                    color = f"C{agents.index(one['agent'])}"
                    times = [time / unit for time in one[clock]]
                    axes.plot(times, one["return"], color=color, label=one["agent"])
            for number, (agent, about) in enumerate(published.items(), len(agents)):
                found = about["returns"].get(task) if clock == "frames" else None
                if found:
                    points = [(int(at) / unit, mean) for at, mean in found.items()]
                    style = {"color": f"C{number}", "label": f"{agent}, published"}
                    axes.plot(*zip(*points, strict=True), "o", **style)
            axes.set(xlabel=label, ylabel="return", title=title(task), visible=True)
            axes.grid(alpha=0.3)
            if task.startswith("dmc_"):
                axes.set_ylim(0, 1050)
    legend(figure, panels.flat, columns=4)
    figure.savefig(path, dpi=110)


def speed(file: Path) -> None:
    """Steps per second over the number of environments, if the results in ``file`` have any.

    The picture is named as the file.
    """
    rows = [
        row
        for row in json.loads(file.read_text("utf-8"))["cases"].values()
        if row["group"] == "environments" and row["status"] == "ok"
    ]
    tasks = list(dict.fromkeys(row["arguments"]["task"] for row in rows))
    if not tasks:
        return
    figure, panels = panels_in_pairs(len(tasks), sharey=True)
    for panel, task in zip(panels, tasks, strict=True):
        for obs_mode, label in (("state", "state only"), ("pixels", "84 x 84 pixels")):
            points = sorted(
                (row["arguments"]["num_envs"], row["values"]["steps_per_second"])
                for row in rows
                if row["arguments"]["task"] == task and row["arguments"].get("obs_mode") == obs_mode
            )
            panel.semilogx([x for x, _ in points], [y for _, y in points], "o-", label=label)
        panel.set(title=title(task), xlabel="environments", ylabel="steps a second")
        panel.yaxis.set_major_formatter("{x:,.0f}")
    panels[0].set_ylim(bottom=0)  # of all, which share it
    legend(figure, panels, columns=2)
    figure.savefig(file.with_suffix(".png"), dpi=130)
    plt.close(figure)
