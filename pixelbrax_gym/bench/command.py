"""The command ``pixelbrax bench``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from subprocess import SubprocessError

from pixelbrax_gym.bench.case import Case, Group
from pixelbrax_gym.bench.cases import COMPILED, FULL, QUICK, TASKS
from pixelbrax_gym.bench.runner import StoppedError, measure_all
from pixelbrax_jax.extras import install_extra


def main(arguments: Sequence[str]) -> int:
    """Run the command; see ``pixelbrax bench --help``.

    Returns:
        The exit status: 1 if a case failed for another reason than memory or something absent,
        130 after Ctrl-C, which loses nothing.
    """
    parser = argparse.ArgumentParser(
        prog="pixelbrax bench",
        description="Measures renderer, environments and adapters on this machine, in two to "
        "three minutes, and writes JSON, a page of tables and a plot. What has been measured is "
        "kept: a run that was stopped goes on where it was.",
    )
    parser.add_argument(
        "--full",
        action="store_true",
        help="more tasks, batches and repetitions, and distractors; hours on a CPU",
    )
    tasks = ("inverted_pendulum", *TASKS)
    add_options(parser, [*FULL, *COMPILED], "runs/bench", tasks)
    options = parser.parse_args(arguments)
    groups = FULL if options.full else QUICK
    if compiled := set(COMPILED).intersection(options.only or ()):
        if others := set(options.only).difference(compiled):
            parser.error(f"{' '.join(sorted(compiled))} runs nothing: leave out {' '.join(others)}")
        groups = COMPILED
        options.output_dir /= "compiled"
    elif options.full:
        options.output_dir /= "full"
    if lacking := [name for name in options.only or () if name not in groups]:
        parser.error(f"--only {' '.join(lacking)} is measured by --full alone; add it")
    return run(parser.prog, options, groups, options.only or list(groups))


def add_options(
    parser: argparse.ArgumentParser,
    names: Sequence[str],
    output_dir: str,
    tasks: Sequence[str] = TASKS,
) -> None:
    """Add what every benchmark takes.

    Args:
        parser: the command's.
        names: parts of the benchmark.
        output_dir: where results are kept unless another folder is given.
        tasks: those that are measured.
    """
    parser.add_argument(
        "--output-dir",
        type=Path,
        default=Path(output_dir),
        help=f"where results are kept (default: {output_dir})",
    )
    parser.add_argument("--only", nargs="+", choices=names, help="parts to measure")
    parser.add_argument("--task", nargs="+", choices=tasks, help="only cases of these tasks")
    parser.add_argument("--max-envs", type=int, help="only cases of at most so many environments")
    parser.add_argument("--again", action="store_true", help="measure anew what has been measured")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds of one case at most")
    parser.add_argument("--list", action="store_true", help="list the cases and stop")


def run(
    program: str, options: argparse.Namespace, groups: Mapping[str, Group], chosen: Sequence[str]
) -> int:
    """Measure the chosen groups as the options say, and tell where the results are.

    Returns:
        The exit status, as ``main``.
    """
    cases = [case for name in chosen for case in groups[name].cases() if fits(case, options)]
    if not cases:
        sys.stderr.write(f"{program}: no case fits --task and --max-envs\n")
        return 1
    if options.list:
        sys.stdout.write("".join(f"{case.key}\n" for case in cases))
        return 0
    try:
        file, failed = measure_all(
            cases, groups, options.output_dir, again=options.again, timeout=options.timeout
        )
    except KeyboardInterrupt:
        sys.stderr.write(f"\n{program}: stopped; the same command goes on from here\n")
        return 130
    except StoppedError as stopped:
        sys.stderr.write(f"\n{program}: {stopped}; the same command goes on from here\n")
        return 128 + stopped.signal
    except (OSError, ValueError, RuntimeError, MemoryError, SubprocessError) as error:
        sys.stderr.write(f"{program}: {error}\n")
        return 1
    page, picture = file.with_suffix(".md"), file.with_suffix(".png")
    if groups is QUICK:
        sys.stdout.write(f"\n{page.read_text('utf-8')}\n")
    sys.stdout.write(f"Tables: {page.resolve()}\n")
    if find_spec("matplotlib") is None:
        sys.stdout.write(f"A plot needs matplotlib; try: {install_extra('demo')}\n")
    elif picture.exists():
        sys.stdout.write(f"Plot: {picture.resolve()}\n")
    return int(failed)


def fits(case: Case, options: argparse.Namespace) -> bool:
    """Whether the case is among those that the options ask for."""
    largest = max(case.arguments.get("sizes", [case.arguments.get("num_envs", 0)]))
    few = options.max_envs is None or largest <= options.max_envs
    return few and (not options.task or case.arguments.get("task") in options.task)
