"""Measures all that ``pixelbrax bench --full`` does, and more.

python -m tests.benchmarks.run                      all but what takes other packages; hours
python -m tests.benchmarks.run --only startup       one part; minutes
python -m tests.benchmarks.run --only peers         others beside us, installed on first use
python -m tests.benchmarks.run --only dmc           every task of the DM Control Suite; half an hour
python -m tests.benchmarks.run --only gpu-program   programs for an H100, compiled; half an hour
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from pixelbrax_gym.bench.cases import TASKS
from pixelbrax_gym.cli import bench
from pixelbrax_jax.tasks import DMC_TASKS
from pixelbrax_jax.validation import check_choice
from tests.benchmarks import plots
from tests.benchmarks.cases import GROUPS

ON_REQUEST = ("peers", "dmc", "gpu-program", "tpu-program")
"""They need what is not installed with the tests: OpenGL, other simulators, compilers."""


@dataclass(frozen=True)
class Options(bench.Options):
    """Measures all that ``pixelbrax bench --full`` does, and more."""

    output_dir: Path = Path("runs/benchmarks")
    only: tuple[str, ...] = ()  # type: ignore[assignment]
    task: tuple[str, ...] = ()  # type: ignore[assignment]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; the exit status is as that of ``pixelbrax bench``."""
    options = tyro.cli(Options, description=__doc__, args=arguments)
    for name in options.only:
        check_choice("part", name, GROUPS)
    for name in options.task:
        check_choice("task", name, ("inverted_pendulum", *TASKS, *DMC_TASKS))
    names = options.only or [name for name in GROUPS if name not in ON_REQUEST]
    status = bench.measure_groups(options, GROUPS, names)
    for file in options.output_dir.glob("*.json"):
        plots.speed(file)
    return status


if __name__ == "__main__":
    sys.exit(main())
