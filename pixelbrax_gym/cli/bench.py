"""Measure the speed of this machine."""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from subprocess import SubprocessError
from typing import Literal

from pixelbrax_gym.bench.case import Case, Group
from pixelbrax_gym.bench.cases import FULL, QUICK
from pixelbrax_gym.cli import CommandError, parse
from pixelbrax_jax.extras import install_extra


@dataclass(frozen=True)
class Options:
    """Measures renderer, environments and adapters on this machine, in two to three minutes.

    Writes JSON, a page of tables and a plot. A stopped run continues where it stopped.
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
    from pixelbrax_gym.bench.runner import measure_all

    cases = [case for name in chosen for case in groups[name].cases() if _fits(case, options)]
    if not cases:
        raise ValueError("no case fits --task and --max-envs; --list shows all cases")
    if options.list:
        sys.stdout.write("".join(f"{case.key}\n" for case in cases))
        return 0
    try:
        file, failed = measure_all(
            cases, groups, options.output_dir, again=options.again, timeout=options.timeout
        )
    except KeyboardInterrupt as stopped:
        number = stopped.args[0] if stopped.args else signal.SIGINT
        name = signal.Signals(number).name
        sys.stderr.write(f"\nstopped by {name}; run the same command again to continue\n")
        return int(128 + number)
    except (RuntimeError, SubprocessError) as error:
        raise CommandError(str(error)) from error
    page, picture = file.with_suffix(".md"), file.with_suffix(".png")
    if groups is QUICK:
        sys.stdout.write(f"\n{page.read_text('utf-8')}\n")
    sys.stdout.write(f"Tables: {page.resolve()}\n")
    if find_spec("matplotlib") is None:
        sys.stdout.write(f"A plot needs matplotlib; try: {install_extra('demo')}\n")
    elif picture.exists():
        sys.stdout.write(f"Plot: {picture.resolve()}\n")
    return int(failed)


def _fits(case: Case, options: Options) -> bool:
    largest = max(case.arguments.get("sizes", [case.arguments.get("num_envs", 0)]))
    few = options.max_envs is None or largest <= options.max_envs
    return few and (not options.task or case.arguments.get("task") in options.task)
