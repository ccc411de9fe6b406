"""Plots of a report: steps per second over the number of environments, and learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt

from tests.benchmarks.case import Row
from tests.benchmarks.plots import legend, panels_in_pairs
from tests.benchmarks.tables import succeeded, title


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draw what there is of each plot, and return the files."""
    done = succeeded(list(rows))
    drawn = []
    for name, function in (("speeds", _speeds), ("learning", _learning)):
        of_group = [row for row in done if row["group"] == name]
        if of_group:
            drawn.append(folder / f"{name}.png")
            part = drawn[-1].with_suffix(".part.png")
            function(of_group).savefig(part, dpi=130)
            part.replace(drawn[-1])
            plt.close("all")
    return drawn


def _speeds(rows: list[Row]) -> plt.Figure:
    """A panel for each task; a color for each observation, dashes for actions of a network."""
    rows = [
        row
        for row in rows
        if not row["arguments"]["flags"] and row["arguments"]["engine"] == "auto"
    ]
    tasks = list(dict.fromkeys(row["arguments"]["task"] for row in rows))
    kinds = sorted({row["arguments"]["size"] or 0 for row in rows})
    figure, panels = panels_in_pairs(len(tasks), sharey=True)
    for panel, task in zip(panels, tasks, strict=True):
        for policy, style in (("random", "o-"), ("network", "s--")):
            for size in kinds:
                points = sorted(
                    (where["num_envs"], row["values"]["steps_per_second"])
                    for row in rows
                    if (where := row["arguments"])["task"] == task
                    and (where["size"] or 0, where["policy"]) == (size, policy)
                )
                if points:
                    label = f"{size} x {size}" if size else "state"
                    panel.loglog(
                        *zip(*points, strict=True), style, color=f"C{kinds.index(size)}",
                        label=f"{label}, {policy}", markersize=4,
                    )  # fmt: skip
        panel.set(title=title(task), xlabel="environments", ylabel="steps a second")
    legend(figure, panels, columns=4)
    return figure


def _learning(rows: list[Row]) -> plt.Figure:
    """A panel for each run."""
    figure, panels = panels_in_pairs(len(rows))
    for panel, row in zip(panels, rows, strict=True):
        where, curve = row["arguments"], row["values"]["curve"]
        panel.plot([at for at, _, _ in curve], [value for _, _, value in curve])
        name = f"{where['algorithm']}, {where['preset']}: {title(where['task'])}"
        panel.set(title=name, xlabel="seconds of training", ylabel="return in training")
    return figure
