"""Runs cases, each in a process of its own, and keeps what comes out."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench import report, tables
from pixelbrax_gym.bench.case import ABSENT, AbsentError, Case, Group
from pixelbrax_gym.bench.machine import file_stem
from pixelbrax_gym.bench.results import Results
from pixelbrax_jax.stop_signals import signal_name, stop_signals

OUT_OF_MEMORY = (
    "resource_exhausted",
    "out of memory",
    "out_of_memory",
    "memoryerror",
    "bad_alloc",
    "cannot allocate memory",
)


class KilledError(RuntimeError):
    """The system killed a process, most likely for its memory."""


class StoppedError(BaseException):
    """A signal other than SIGINT asks for an end, which no handler of errors may hold up.

    Attributes:
        signal: its number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal_name(number)}")
        self.signal = number


def measure_all(
    cases: Sequence[Case],
    groups: Mapping[str, Group],
    output_dir: Path,
    *,
    again: bool = False,
    timeout: float = 900.0,
) -> tuple[Path, bool]:
    """Measure what is not known yet of this machine, and write results, page and plot.

    A run that is cut short loses nothing, and the next one goes on where it stopped.

    Args:
        cases: what to measure.
        groups: parts of the page, which shows what else the file holds of them.
        output_dir: folder of the files.
        again: measure anew what is known.
        timeout: seconds of one case at most.

    Returns:
        The JSON file, and whether a case failed for another reason than memory or something
        absent.

    Raises:
        StoppedError: by a signal.
    """
    # A process must not outlive this one and disturb the next one's measurements.
    before = {
        number: signal.signal(number, _stopped)
        for number in stop_signals()
        if number != signal.SIGINT
    }
    describe = Case("machine", "machine.describe")
    machine = process(describe.command(), {}, 300.0)["values"]
    file = output_dir / f"{file_stem(machine)}.json"
    results = Results(file, machine)
    todo = [case for case in cases if again or not results.has(case)]
    output_dir.mkdir(parents=True, exist_ok=True)
    _say(f"{len(todo)} of {len(cases)} cases are to be measured; results in {file}")
    failed = False
    try:
        for index, case in enumerate(todo, 1):
            _say(f"{index}/{len(todo)}  {_name(case)} ...", end="")
            outcome = measure(case, timeout)
            failed |= outcome["status"] == "failed"
            results.add(case, outcome)
            _say(f" {_told(outcome)} ({outcome['seconds']:.0f} s)")
    finally:
        if file.exists():
            report.write(file, groups)
        for number, handler in before.items():
            signal.signal(number, handler)
    return file, failed


def measure(case: Case, timeout: float) -> dict[str, Any]:
    """The outcome of a case: its values, or why there are none."""
    started = time.perf_counter()
    try:
        outcome = {"status": "ok"} | process(case.command(), case.environ(), timeout)
    except AbsentError as error:
        outcome = {"status": "absent", "why": str(error)}
    except MemoryError as error:
        outcome = {"status": "out of memory", "why": str(error)}
    except KilledError as error:
        outcome = {"status": "killed", "why": str(error)}
    except subprocess.TimeoutExpired:
        outcome = {"status": "failed", "why": f"took longer than {timeout:.0f} s"}
    except (RuntimeError, OSError) as error:
        outcome = {"status": "failed", "why": str(error)[-2000:]}
    outcome["seconds"] = round(time.perf_counter() - started, 1)
    return outcome


def process(command: Sequence[str], environ: Mapping[str, str], timeout: float) -> dict[str, Any]:
    """What a process writes in its last line, as JSON.

    Raises:
        AbsentError: something to be measured is not here.
        KilledError: the system killed it.
        MemoryError: there was not enough.
        RuntimeError: it failed otherwise.
        subprocess.TimeoutExpired: it took too long.
    """
    # Compilation is to be measured, and errors are to be told in their own words.
    own = {"JAX_ENABLE_COMPILATION_CACHE": "false", "JAX_TRACEBACK_FILTERING": "off"}
    status, output, errors = _run(command, {**os.environ, **own, **environ}, timeout)
    if status == 0:
        try:
            found = json.loads(output.strip().splitlines()[-1])
            return {"values": found["values"], "peak_bytes": found.get("peak_bytes")}
        except (ValueError, TypeError, KeyError, IndexError) as error:
            raise RuntimeError(f"its last line is no result: {output[-200:]!r}") from error
    lines = errors.strip().splitlines()
    why = lines[-1] if lines else f"exit status {status}"
    if os.name == "posix" and status == -signal.SIGKILL:
        raise KilledError("killed by the system, most likely for its memory")
    if status == ABSENT:
        raise AbsentError(why)
    if any(word in errors.lower() for word in OUT_OF_MEMORY):
        raise MemoryError(why)
    raise RuntimeError("\n".join(lines[-20:]) or why)


def _run(
    command: Sequence[str], environ: Mapping[str, str], timeout: float
) -> tuple[int, str, str]:
    """Exit status, output and errors of a command; none of its processes outlives this call."""
    with subprocess.Popen(
        command,
        env=environ,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        try:
            output, errors = child.communicate(timeout=timeout)
        finally:
            _stop(child)
    return child.returncode, output, errors


def _stop(child: subprocess.Popen[str]) -> None:
    """End the process and those that it began."""
    if os.name != "posix":
        child.kill()
        return
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)


def _stopped(number: int, frame: Any) -> None:
    del frame
    raise StoppedError(number)


def _name(case: Case) -> str:
    return " ".join([case.group, *(f"{k}={v}" for k, v in case.arguments.items())])


def _told(outcome: dict[str, Any]) -> str:
    """An outcome in some words."""
    if outcome["status"] != "ok":
        return f"{outcome['status']}: {outcome['why'].strip().splitlines()[-1]}"
    values = outcome["values"]
    for name, unit in (("steps_per_second", "steps/s"), ("frames_per_second", "frames/s")):
        if name in values:
            return f"{tables.number(values[name])} {unit}"
    return "done"


def _say(text: str, end: str = "\n") -> None:
    sys.stdout.write(text + end)
    sys.stdout.flush()
