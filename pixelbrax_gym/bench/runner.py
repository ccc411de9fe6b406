"""Run cases in separate processes and store their outcomes."""

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

from pixelbrax_gym.bench import report
from pixelbrax_gym.bench.case import ABSENT, AbsentError, Case, Group
from pixelbrax_gym.bench.machine import file_stem
from pixelbrax_gym.bench.results import Results
from pixelbrax_gym.bench.tables import number
from pixelbrax_jax.stop_signals import handling

OUT_OF_MEMORY = (
    "resource_exhausted",
    "out of memory",
    "out_of_memory",
    "memoryerror",
    "bad_alloc",
    "cannot allocate memory",
)


def measure_all(
    cases: Sequence[Case],
    groups: Mapping[str, Group],
    output_dir: Path,
    *,
    again: bool = False,
    timeout: float = 900.0,
) -> tuple[Path, bool]:
    """Measure the cases without a result on this machine and write results, page and plot.

    Returns the JSON file, and whether a case failed other than by memory or an absent package.

    Raises:
        KeyboardInterrupt: a signal to stop arrived, with its number; the results are written.
    """
    # A process that outlives this one would disturb later measurements.
    with handling(_interrupt):
        machine = measure(Case("machine", "machine.describe"), 300.0)
        if machine["status"] != "ok":
            raise RuntimeError(machine["why"])
        file = output_dir / f"{file_stem(machine['values'])}.json"
        results = Results(file, machine["values"])
        todo = [case for case in cases if again or not results.has(case)]
        output_dir.mkdir(parents=True, exist_ok=True)
        _say(f"{len(todo)} of {len(cases)} cases to measure; results in {file}\n")
        failed = False
        try:
            for index, case in enumerate(todo, 1):
                about = " ".join(f"{k}={v}" for k, v in case.arguments.items())
                _say(f"{index}/{len(todo)}  {case.group} {about} ...")
                outcome = measure(case, timeout)
                failed |= outcome["status"] == "failed"
                results.add(case, outcome)
                _say(f" {_in_words(outcome)} ({outcome['seconds']:.0f} s)\n")
        finally:
            if file.exists():
                report.write(file, groups)
    return file, failed


def measure(case: Case, timeout: float) -> dict[str, Any]:
    """Run a case; return its ``status`` and ``values``, or ``why`` it has no values."""
    started = time.perf_counter()
    try:
        outcome = run_process(case.command(), case.environ(), timeout)
    except AbsentError as error:
        outcome = {"status": "absent", "why": str(error)}
    except OSError as error:
        outcome = {"status": "failed", "why": str(error)}
    return {**outcome, "seconds": round(time.perf_counter() - started, 1)}


def run_process(
    command: Sequence[str], environ: Mapping[str, str], timeout: float
) -> dict[str, Any]:
    """Run a command whose last line is its result as JSON, then kill the processes it started."""
    # Without the cache, compilation is measured; without filtering, errors keep their messages.
    own = {"JAX_ENABLE_COMPILATION_CACHE": "false", "JAX_TRACEBACK_FILTERING": "off"}
    with subprocess.Popen(
        command,
        env={**os.environ, **own, **environ},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        try:
            output, errors = child.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            return {"status": "failed", "why": f"took longer than {timeout:.0f} s"}
        finally:
            _kill(child)
    lines = errors.strip().splitlines()
    last = lines[-1] if lines else f"exit status {child.returncode}"
    if os.name == "posix" and child.returncode == -signal.SIGKILL:
        return {"status": "killed", "why": "by the system, probably because memory ran out"}
    if child.returncode == ABSENT:
        return {"status": "absent", "why": last}
    if child.returncode != 0:
        if any(word in errors.lower() for word in OUT_OF_MEMORY):
            return {"status": "out of memory", "why": last}
        return {"status": "failed", "why": "\n".join(lines[-20:])[-2000:] or last}
    try:
        found = json.loads(output.strip().splitlines()[-1])
        return {"status": "ok", "values": found["values"], "peak_bytes": found.get("peak_bytes")}
    except (ValueError, TypeError, LookupError):
        return {"status": "failed", "why": f"its last line is not a result: {output[-200:]!r}"}


def _kill(child: subprocess.Popen[str]) -> None:
    """Kill the process and those it started."""
    if os.name != "posix":
        child.kill()
        return
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)


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
