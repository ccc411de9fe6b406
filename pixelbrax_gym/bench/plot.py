"""Steps per second over the number of environments, as a picture."""

from __future__ import annotations

import os
from pathlib import Path

from pixelbrax_gym.bench.case import Row
from pixelbrax_gym.bench.tables import succeeded, title

DM_CONTROL = {
    "halfcheetah": "cheetah",
    "walker2d": "walker",
    "ant": "quadruped",
    "humanoid": "humanoid",
}
"""Task -> DM Control's domain of the same class."""


def plot(rows: list[Row], path: Path) -> bool:
    """Draw a panel for each task.

    It is Figure 2 of arXiv 2502.00021 redrawn, with state alone beside it, and DM Control where
    that has been measured.

    Returns:
        Whether there was anything to draw.

    Raises:
        ImportError: matplotlib is not installed.
    """
    chosen = [row for row in succeeded(rows) if row["group"] in ("environments", "peers")]
    tasks = {r["arguments"]["task"]: None for r in chosen if r["group"] == "environments"}
    if not tasks:
        return False
    # What other tools leave there keeps matplotlib from being imported.
    os.environ["MPLBACKEND"] = "Agg"
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1,
        len(tasks),
        figsize=(1 + 3 * len(tasks), 3.6),
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for panel, task in zip(panels[0], tasks, strict=True):
        of_task = [row for row in chosen if row["arguments"].get("task") == task]
        for obs_mode, label in (("state", "state only"), ("pixels", "84 x 84 pixels")):
            points = [
                (row["arguments"]["num_envs"], row["values"]["steps_per_second"])
                for row in of_task
                if row["arguments"].get("obs_mode") == obs_mode
            ]
            panel.loglog(*_columns(points), "o-", label=label)
        points = [
            (max(1, row["values"]["processes"]), row["values"]["steps_per_second"])
            for row in of_task
            if row["measure"] == "peers.dm_control_envs"
        ]
        if points:
            panel.loglog(*_columns(points), "s--", label=f"DM Control {DM_CONTROL[task]}, pixels")
        panel.set(title=title(task), xlabel="environments")
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    panels[0, 0].set_ylabel("steps / s")
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return True


def _columns(points: list[tuple[int, float]]) -> tuple[list[int], list[float]]:
    points = sorted(points)
    return [x for x, _ in points], [y for _, y in points]
