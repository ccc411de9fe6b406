"""Measure the speed of this machine."""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pixelbrax_gym.bench import runner
from pixelbrax_gym.bench.cases import FULL, QUICK, Case, Group
from pixelbrax_gym.bench.machine import file_stem
from pixelbrax_gym.bench.report import Results
from pixelbrax_gym.bench.tables import number
from pixelbrax_gym.cli import CommandError, parse
from pixelbrax_jax.stop_signals import handling


@dataclass(frozen=True)
class Options:
    """Measures renderer, environments and adapters on this machine, in two to three minutes.

    Writes JSON and a page of tables. A stopped run continues where it stopped.
    """

    full: bool = False
    """Measures more tasks, batches and looks, which takes hours on a CPU."""
    output_dir: Path = Path("runs/bench")
    """Folder for the results."""
    only: tuple[Literal["renderer", "environments", "adapters"], ...] = ()
    """Measures only these parts; default: all."""
    task: tuple[
        Literal["inverted_pendulum", "halfcheetah", "walker2d", "ant", "humanoid"], ...
    ] = ()
    """Measures only cases of these tasks."""
    max_envs: int | None = None
    """Skips cases with more environments than this."""
    again: bool = False
    """Repeats cases that already have a result."""
    timeout: float = 900.0
    """Time limit of one case in seconds."""
    list: bool = False
    """Lists the cases and exits."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("bench", Options, arguments)
    groups = FULL if options.full else QUICK
    if options.full:
        options = replace(options, output_dir=options.output_dir / "full")
    return measure_groups(options, groups, options.only or list(groups))


def measure_groups(options: Options, groups: Mapping[str, Group], chosen: Sequence[str]) -> int:
    """Measure the chosen groups and print the paths of the results.

    The exit status is 1 if a case failed, but 0 if it only ran out of memory or was absent.
    """
    cases = [case for name in chosen for case in groups[name].cases if _fits(case, options)]
    if not cases:
        raise ValueError("no case fits --task and --max-envs; --list shows all cases")
    if options.list:
        sys.stdout.write("".join(f"{case.key}\n" for case in cases))
        return 0
    # A process that outlives this one would disturb later measurements.
    try:
        with handling(_interrupt):
            return _measure(cases, groups, options)
    except KeyboardInterrupt as stopped:
        stopped_by = stopped.args[0] if stopped.args else signal.SIGINT
        name = signal.Signals(stopped_by).name
        sys.stderr.write(f"\nstopped by {name}; run the same command again to continue\n")
        return int(128 + stopped_by)


def _measure(cases: Sequence[Case], groups: Mapping[str, Group], options: Options) -> int:
    """Measure the cases without a result on this machine; write each result, and the page."""
    machine = runner.measure(Case("machine", "machine.describe"), 300.0)
    if machine["status"] != "ok":
        raise CommandError(machine["why"])
    file = options.output_dir / f"{file_stem(machine['values'])}.json"
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
            results.write_page(groups)
    page = file.with_suffix(".md")
    if groups is QUICK:
        _say(f"\n{page.read_text('utf-8')}\n")
    _say(f"Tables: {page.resolve()}\n")
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
