"""Measures this machine, and others beside us; tables and a plot in runs/benchmarks.

python -m tests.benchmarks.run                      all but what takes other packages; hours
python -m tests.benchmarks.run --only startup       one part; minutes
python -m tests.benchmarks.run --only peers         others beside us, installed on first use
python -m tests.benchmarks.run --only dmc           every task of the DM Control Suite; half an hour
python -m tests.benchmarks.run --only gpu-program   programs for an H100, compiled; half an hour
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from pixelbrax_gym.bench.tables import number
from pixelbrax_jax.stop_signals import handling
from pixelbrax_jax.tasks import DMC_TASKS
from pixelbrax_jax.validation import check_choice
from tests.benchmarks import plots, runner
from tests.benchmarks.case import TASKS, Case
from tests.benchmarks.cases import GROUPS
from tests.benchmarks.report import Results

ON_REQUEST = ("peers", "dmc", "dmc-look", "gpu-program", "tpu-program")
"""They need what is not installed with the tests: OpenGL, other simulators, compilers."""


@dataclass(frozen=True)
class Options:
    """Writes JSON and a page of tables. A stopped run continues where it stopped."""

    output_dir: Path = Path("runs/benchmarks")
    """Folder for the results."""
    only: tuple[str, ...] = ()
    """Measures only these parts; default: all but those on request."""
    task: tuple[str, ...] = ()
    """Measures only cases of these tasks."""
    max_envs: int | None = None
    """Skips cases with more environments than this."""
    again: bool = False
    """Repeats cases that already have a result."""
    timeout: float = 900.0
    """Time limit of one case in seconds."""
    list: bool = False
    """Lists the cases and exits."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark.

    The exit status is 1 if a case failed, but 0 if it only ran out of memory or was absent.
    """
    options = tyro.cli(Options, description=__doc__, args=arguments)
    for name in options.only:
        check_choice("part", name, GROUPS)
    for name in options.task:
        check_choice("task", name, ("inverted_pendulum", *TASKS, *DMC_TASKS))
    names = options.only or [name for name in GROUPS if name not in ON_REQUEST]
    cases = [case for name in names for case in GROUPS[name].cases if _fits(case, options)]
    if not cases:
        raise ValueError("no case fits --task and --max-envs; --list shows all cases")
    if options.list:
        sys.stdout.write("".join(f"{case.key}\n" for case in cases))
        return 0
    # A process that outlives this one would disturb later measurements.
    try:
        with handling(_interrupt):
            status = _measure(cases, options)
    except KeyboardInterrupt as stopped:
        stopped_by = stopped.args[0] if stopped.args else signal.SIGINT
        name = signal.Signals(stopped_by).name
        sys.stderr.write(f"\nstopped by {name}; run the same command again to continue\n")
        status = int(128 + stopped_by)
    return status


def _measure(cases: Sequence[Case], options: Options) -> int:
    """Measure the cases without a result on this machine; write each result, and the page."""
    machine = runner.measure(Case("machine", "machine.describe"), 300.0)
    if machine["status"] != "ok":
        raise RuntimeError(machine["why"])
    file = options.output_dir / f"{_stem(machine['values'])}.json"
    results = Results(file, machine["values"])
    todo = [case for case in cases if options.again or not results.has(case)]
    options.output_dir.mkdir(parents=True, exist_ok=True)
    _say(f"{len(todo)} of {len(cases)} cases to measure; results in {file}\n")
    failed = False
    try:
        for index, case in enumerate(todo, 1):
            about = " ".join(f"{k}={v}" for k, v in case.arguments.items())
            _say(f"{index}/{len(todo)}  {case.group} {about} ...")
            outcome = runner.measure(case, options.timeout)
            failed |= outcome["status"] == "failed"
            results.add(case, outcome)
            _say(f" {_in_words(outcome)} ({outcome['seconds']:.0f} s)\n")
    finally:
        if file.exists():
            results.write_page(GROUPS)
            plots.speed(file)
    _say(f"Tables: {file.with_suffix('.md').resolve()}\n")
    return int(failed)


def _fits(case: Case, options: Options) -> bool:
    largest = max(case.arguments.get("sizes", [case.arguments.get("num_envs", 0)]))
    few = options.max_envs is None or largest <= options.max_envs
    return few and (not options.task or case.arguments.get("task") in options.task)


def _interrupt(number: int, _frame: Any) -> None:
    raise KeyboardInterrupt(number)


def _in_words(outcome: dict[str, Any]) -> str:
    if outcome["status"] != "ok":
        return f"{outcome['status']}: {outcome['why'].strip().splitlines()[-1]}"
    values = outcome["values"]
    for name, unit in (("steps_per_second", "steps/s"), ("frames_per_second", "frames/s")):
        if name in values:
            return f"{number(values[name])} {unit}"
    return "done"


def _say(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()


def _stem(machine: dict[str, Any]) -> str:
    """Return the stem of the result files: the platform, and the vector extension of a CPU."""
    vectors: str = machine["vectors"] if machine["platform"] == "cpu" else ""
    return "-".join(filter(None, (machine["platform"], vectors.lower().replace("-", ""))))


if __name__ == "__main__":
    sys.exit(main())
