"""Writes tables and figures into the pages of the documentation, from what is kept in docs.

python -m tests.benchmarks.figures            pages; a test fails where this changes one
python -m tests.benchmarks.figures --plots    plots, too
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import itertools
import json
from dataclasses import fields
from pathlib import Path

import pixelbrax_jax as pb
from pixelbrax_gym.bench.tables import table
from pixelbrax_gym.cli import _leaderboard as leaderboard
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.benchmarks import (
    dmc_page,
    generalisation,
    generalisation_minutes,
    gym_page,
    performance,
    report,
    results,
    task_pages,
)
from tests.benchmarks.cases import GROUPS
from tests.benchmarks.pages import Figures, filled

ROOT = Path(__file__).parents[2]


def brax_tasks() -> str:
    """Brax's tasks."""
    lines = [
        [
            f"`{task.gymnasium_id}`",
            f"`{name}`",
            pb.make(name, obs_mode="state")[0].action_size,
            ", ".join([task.default_backend, *sorted({*task.backends} - {task.default_backend})]),
            task.summary,
        ]
        for name, task in BRAX_TASKS.items()
    ]
    return table(("Gymnasium id", "name", "actions", "backends", "goal and end"), lines)


def options() -> str:
    """Every option of an environment, with its default and its documentation."""
    about = {}
    for kind in pb.EnvConfig.__mro__[:-1]:
        lines = ast.parse(inspect.getsource(kind)).body[0].body
        for field, text in itertools.pairwise(lines):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                about[field.target.id] = ast.literal_eval(text.value)
    lines = [
        [
            f"`{field.name}`",
            f"`{json.dumps(field.default) if isinstance(field.default, str) else field.default}`",
            " ".join(about[field.name].split()).replace("``", "`"),
        ]
        for field in fields(pb.EnvConfig)
        if field.name != "task"
    ]
    return table(("option", "default", "meaning"), lines)


def public(package: str, *more: str) -> Figures:
    """What is importable from a package, for ``mkdocstrings``, by the package's name."""

    def directives() -> str:
        root = importlib.import_module(package)
        named = {name: getattr(root, name) for name in sorted({*root.__all__, *more})}
        return "".join(
            f"\n::: {getattr(value, '__module__', package)}.{name}\n"
            for name, value in named.items()
            if not inspect.ismodule(value) and (root is pb or getattr(pb, name, None) is not value)
        )

    return {package.replace(".", "-").replace("_", "-"): directives}


PAGES: dict[str, Figures] = {
    "README.md": {
        **performance.README,
        **dmc_page.README,
        "halfcheetah": results.FIGURES["halfcheetah"],
    },
    "docs/performance.md": performance.PERFORMANCE,
    "docs/accelerators.md": performance.ACCELERATORS,
    "docs/benchmarks/programs.md": performance.COMPILED_PROGRAMS,
    "docs/results.md": results.FIGURES,
    "docs/benchmarks/learning.md": results.RUNS,
    "docs/agents/tried.md": results.TRIED,
    "docs/agents/drqv2.md": results.DRQV2,
    "docs/leaderboard.md": {"board": lambda: leaderboard.page(ROOT / "docs/leaderboard")},
    "docs/dmc.md": dmc_page.FIGURES,
    "docs/benchmarks/dmc.md": dmc_page.ALL,
    "docs/howto/dm-control.md": dmc_page.TRANSFER,
    "docs/benchmarks/generalisation.md": generalisation.FIGURES | generalisation_minutes.FIGURES,
    "docs/howto/generalisation.md": {
        "example": generalisation.example,
        "minutes": generalisation_minutes.minutes,
    },
    "docs/gym-tasks.md": gym_page.FIGURES,
    "docs/tasks.md": {"tasks": brax_tasks},
    **{f"docs/tasks/{suite}.md": figures for suite, figures in task_pages.FIGURES.items()},
    "docs/options.md": {"options": options},
    "docs/api.md": {
        **public("pixelbrax_jax"),
        **public("pixelbrax_jax.distractors"),
        **public("pixelbrax_jax.agents"),
        **public("pixelbrax_gym", "SB3VecEnv", "TorchPolicy", "TorchRLEnv"),
    },
}
"""Page -> its tables and figures, by name."""

BENCHMARKS = {"cpu-avx512": "AVX-512", "cpu-avx2": "AVX2"}
"""Whole results, each with a page of its own, and their processors."""


def page_of(machine: str) -> str:
    """The page of whole results, with their plot above the first part."""
    text = report.page(performance.read(f"benchmarks/{machine}.json"), GROUPS)
    text = text.replace("# Measurements", f"# Whole benchmark, {BENCHMARKS[machine]}", 1)
    if not (ROOT / f"docs/benchmarks/{machine}.png").exists():
        return text
    plot = f"![Steps per second over the number of environments]({machine}.png)"
    return text.replace("\n\n## ", f"\n\n{plot}\n\n## ", 1)


def main() -> None:
    """Write all pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plots", action="store_true", help="make plots, too")
    options = parser.parse_args()
    for name, figures in PAGES.items():
        page = ROOT / name
        page.write_text(filled(page.read_text("utf-8"), figures), "utf-8")
    for machine in BENCHMARKS:
        (ROOT / f"docs/benchmarks/{machine}.md").write_text(page_of(machine), "utf-8")
    if options.plots:
        from tests.benchmarks import plots

        results.plot()
        for machine in BENCHMARKS:
            plots.speed(ROOT / f"docs/benchmarks/{machine}.json")
        folder = ROOT / "docs/leaderboard"
        if entries := leaderboard.read(folder):
            published = json.loads((folder / leaderboard.PUBLISHED).read_text("utf-8"))["agents"]
            plots.leaderboard(entries, published, folder / "curves.png")


if __name__ == "__main__":
    main()
