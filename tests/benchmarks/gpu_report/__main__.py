"""Measures PixelBrax on an NVIDIA GPU: correctness, speed, adapters, learning, other renderers.

python -m tests.benchmarks.gpu_report                  25 minutes, the most wanted first
python -m tests.benchmarks.gpu_report                  again: goes on where it stopped
python -m tests.benchmarks.gpu_report --rehearse       the same at a small size, on the CPU
python -m tests.benchmarks.gpu_report --tables-only    tables and plots of what is there
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from pixelbrax_gym.bench.tables import number
from pixelbrax_jax.processor import num_cores
from pixelbrax_jax.stop_signals import handling
from tests.benchmarks.gpu_report import schedule
from tests.benchmarks.gpu_report.card import (
    Card,
    CardError,
    check_card,
    installed_cuda,
    read_card,
)
from tests.benchmarks.gpu_report.plan import CARD, REHEARSAL, Timed, plan
from tests.benchmarks.gpu_report.programs import FOLDER
from tests.benchmarks.gpu_report.results import Results
from tests.benchmarks.report import write_whole

TABLES_SECONDS = 15.0
"""Time that is left for tables and plots."""

CONTEXT_GB, PROCESS_GB = 0.8, 2.5
"""Memory of a waiting process on the device and on the host."""


@dataclass(frozen=True)
class Options:
    """Options of the report."""

    minutes: float = 25.0
    """Time in which it ends, with tables of what it has by then."""
    output_dir: Path | None = None
    """Folder of the results; default: runs/gpu-report, or runs/gpu-rehearsal."""
    rehearse: bool = False
    """Does the same on the CPU at a small size."""
    tables_only: bool = False
    """Measures nothing, and makes tables and plots of what the folder has."""
    list: bool = False
    """Lists the cases in their order and exits."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Make a report; the exit status is 0, 1 if a case failed, 2 without a GPU."""
    began = time.monotonic()
    options = tyro.cli(Options, description=__doc__, args=arguments)
    if not options.minutes > 0:
        raise SystemExit(f"gpu-report: --minutes must be greater than 0, got {options.minutes}.")
    folder = options.output_dir or Path(
        "runs/gpu-rehearsal" if options.rehearse else "runs/gpu-report"
    )
    try:
        if options.list:
            extent = REHEARSAL if options.rehearse else CARD
            _say("\n".join(case.key for case in plan(extent)))
            return 0
        if options.tables_only:
            return _tables(folder)
        card = None if options.rehearse else read_card(os.environ)
        for note in check_card(card, installed_cuda(), os.environ) if card else ():
            _say(f"note: {note}")
        with handling(_interrupt):
            return _measure(options, folder, card, began)
    except (CardError, ValueError, OSError) as error:
        _say(f"gpu-report: {error}")
        return 2
    except KeyboardInterrupt as stopped:
        _say("stopped; the same command goes on")
        return 128 + int(stopped.args[0] if stopped.args else signal.SIGINT)


def _measure(options: Options, folder: Path, card: Card | None, began: float) -> int:
    environ = _environ(folder, options.rehearse)
    identity = Timed("card", "checks.identity")
    machine: dict[str, Any] = {}

    def know(_: Timed, outcome: dict[str, Any]) -> None:
        if outcome["status"] != "ok":
            raise CardError(f"JAX does not start: {outcome['why'].splitlines()[-1]}")
        machine.update(outcome["values"], rehearsal=options.rehearse)

    _say(f"{card.name if card else 'the CPU'}: starting JAX ...")
    schedule.run([identity], know, 180.0, 1, environ)
    if not machine:
        raise CardError("JAX does not start within three minutes: try `pixelbrax doctor`.")
    if card and machine["platform"] != "gpu":
        raise CardError(
            f"JAX computes on a {machine['platform']} though there is a {card.name}: "
            "`pixelbrax doctor` says why. --rehearse does the same on the CPU at a small size."
        )
    machine["card"] = asdict(card) if card else None
    results = Results(folder)
    results.start(machine)
    _say(f"{machine['device']}; images are drawn by {machine['renderer']!r}: {machine['why']}")
    usable = options.rehearse or machine["kernel"]
    cases = _that_fit(plan(REHEARSAL if options.rehearse else CARD, usable), card)
    todo = [case for case in cases if not results.has(case)]
    parallel = _parallel(card)
    _say(f"{len(todo)} of {len(cases)} cases to measure, {parallel} at a time to compile")

    def record(case: Timed, outcome: dict[str, Any]) -> None:
        results.add(case, outcome)
        _say(f"{_clock(began)} {_about(case):58} {_in_words(outcome)}")

    try:
        left = 60 * options.minutes - (time.monotonic() - began) - TABLES_SECONDS
        schedule.run(todo, record, left, parallel, environ)
    finally:
        _tables(folder)
    return int(any(row["status"] in ("failed", "killed") for row in results.rows.values()))


def _environ(folder: Path, rehearse: bool) -> dict[str, str]:
    """Return the variables of the processes."""
    folder.mkdir(parents=True, exist_ok=True)
    return {
        **os.environ,
        # Many processes share the card, torch among them.
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        # A cached program would hide how long it takes to compile.
        "JAX_ENABLE_COMPILATION_CACHE": "false",
        "JAX_TRACEBACK_FILTERING": "off",
        "OMP_WAIT_POLICY": "PASSIVE",
        "PIP_RETRIES": "1",
        "PIP_DEFAULT_TIMEOUT": "10",
        FOLDER: str(folder.resolve()),
        # nvidia-smi counts cards in this order, and several would share a training run.
        "CUDA_DEVICE_ORDER": "PCI_BUS_ID",
        "CUDA_VISIBLE_DEVICES": "" if rehearse else _first_card(),
        **({"JAX_PLATFORMS": "cpu"} if rehearse else {}),
    }


def _first_card() -> str:
    return os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0].strip()


def _parallel(card: Card | None) -> int:
    """Return how many cases may compile at once, while as many wait."""
    if card and card.exclusive:
        return 1
    host = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    device = 0.5 * card.free_gb / CONTEXT_GB if card else float("inf")
    return max(1, min(num_cores(), int(0.7 * host / PROCESS_GB / 2), int(min(device, 1e3) / 2)))


def _that_fit(cases: Sequence[Timed], card: Card | None) -> list[Timed]:
    """Return the cases that fit into the card's free memory, and name the rest."""
    free = card.free_gb if card else float("inf")
    fit = [case for case in cases if case.gigabytes <= free]
    if len(fit) < len(cases):
        _say(
            f"note: {len(cases) - len(fit)} of {len(cases)} cases need more than the {free:.1f} GB "
            "that are free, and are left out."
        )
    return fit


def _tables(folder: Path) -> int:
    """Write report.json, report.md and the plots, each in place of its former self."""
    results = Results(folder)
    if not results.machine:
        raise ValueError(f"{folder} has no results of this benchmark: {results.file} is missing.")
    from tests.benchmarks.gpu_report import tables

    machine, rows = results.machine, list(results.rows.values())
    kernel = machine["rehearsal"] or machine["kernel"]
    cases = plan(REHEARSAL if machine["rehearsal"] else CARD, kernel)
    whole = {"machine": machine, "cases": results.rows}
    write_whole(folder / "report.json", json.dumps(whole, indent=1) + "\n")
    write_whole(folder / "report.md", tables.page(machine, rows, cases))
    made = [folder / "report.md", folder / "report.json"]
    try:
        from tests.benchmarks.gpu_report import plots
    except ImportError as error:
        _say(f"note: no plots: {error}")
    else:
        made += plots.draw(rows, folder)
    _say("wrote " + ", ".join(map(str, made)))
    return 0


def _about(case: Timed) -> str:
    known = {k: v for k, v in case.arguments.items() if v not in ("", None, ())}
    return " ".join([case.measure, *(f"{k}={v}" for k, v in known.items())])[:110]


def _in_words(outcome: Mapping[str, Any]) -> str:
    if outcome["status"] != "ok":
        return f"{outcome['status']}: {str(outcome['why']).strip().splitlines()[-1][:160]}"
    values = outcome["values"]
    for name in ("steps_per_second", "frames_per_second"):
        if isinstance(values, dict) and values.get(name):
            return f"{number(values[name])} {name.split('_')[0]}/s"
    return "done"


def _clock(began: float) -> str:
    seconds = int(time.monotonic() - began)
    return f"[{seconds // 60:2}:{seconds % 60:02}]"


def _say(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


def _interrupt(number: int, frame: Any) -> None:
    del frame
    raise KeyboardInterrupt(number)


if __name__ == "__main__":
    sys.exit(main())
