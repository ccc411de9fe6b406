"""The plot of steps per second beside the results of a whole benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

from pixelbrax_gym.bench.tables import title

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def plot(file: Path) -> None:
    """Plot steps per second over the number of environments, if the results in ``file`` have any.

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
    figure, panels = plt.subplots(
        1,
        len(tasks),
        figsize=(1 + 3 * len(tasks), 3.6),
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for panel, task in zip(panels[0], tasks, strict=True):
        for obs_mode, label in (("state", "state only"), ("pixels", "84 x 84 pixels")):
            points = sorted(
                (row["arguments"]["num_envs"], row["values"]["steps_per_second"])
                for row in rows
                if row["arguments"]["task"] == task and row["arguments"].get("obs_mode") == obs_mode
            )
            panel.loglog([x for x, _ in points], [y for _, y in points], "o-", label=label)
        panel.set(title=title(task), xlabel="environments")
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    panels[0, 0].set_ylabel("steps / s")
    figure.savefig(file.with_suffix(".png"), dpi=130)
    plt.close(figure)
