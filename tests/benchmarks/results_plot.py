"""The learning curves of docs/results.md."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from tests.benchmarks.results import return_at

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {"ppo": "C0", "ppg": "C1", "dcpg": "C2"}
BASELINES = {"random": ("random policy", ":"), "none": ("no action", "--")}
"""Label and line."""


def draw(panels: dict[str, tuple[list[list[dict]], dict]], path: Path) -> None:
    """Return over steps: thin lines for seeds, a thick one for their mean, a band between them.

    Steps and not minutes, which depend on the machine.
    """
    figure, all_axes = plt.subplots(
        1, len(panels), figsize=(4 * len(panels), 3.4), layout="constrained", squeeze=False
    )
    for axes, (title, (groups, untrained)) in zip(all_axes[0], panels.items(), strict=True):
        for seeds in groups:
            _curve(axes, seeds)
        for kind, (label, style) in BASELINES.items():
            level = untrained[kind]["return"]
            axes.axhline(level, color="gray", linestyle=style, label=label)
        axes.set(xlabel="million control steps", title=title)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    all_axes[0][0].set_ylabel("return of training episodes")
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
