"""Measures everything, or parts of it, and writes JSON, a page of tables and a plot.

    python -m tests.benchmarks.run                      all but peers; hours
    python -m tests.benchmarks.run --only renderer      one part; minutes
    python -m tests.benchmarks.run --only peers         others beside us, installed on first use

Each case runs in a process of its own: its peak memory is its own, and one that runs out of memory
or crashes is recorded as such while the rest goes on. What has been measured on the same machine
with the same versions is kept; a run that is cut short goes on where it stopped, and --again
measures anew.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tests.benchmarks import report
from tests.benchmarks.cases import ABSENT, GROUPS, TASKS, Case
from tests.benchmarks.machine import file_stem, num_cores
from tests.benchmarks.peers.install import AbsentError, peer_python

ROOT = Path(__file__).parents[2]
OUT_OF_MEMORY = (
    "resource_exhausted",
    "out of memory",
    "out_of_memory",
    "memoryerror",
    "bad_alloc",
    "cannot allocate memory",
)


class KilledError(Exception):
    """The system killed a worker, most likely for its memory."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: of the command line; None means those of this process.

    Returns:
        The exit status: 1 if a case failed for another reason than memory or something absent.
    """
    parser = argparse.ArgumentParser(
        prog="pixelbrax bench", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--output-dir",
        type=Path,
        default=Path("runs/benchmarks"),
        help="where results are kept (default: runs/benchmarks)",
    )
    parser.add_argument("--only", nargs="+", choices=GROUPS, help="parts to measure")
    parser.add_argument("--peers", action="store_true", help="measure peers too")
    parser.add_argument("--task", nargs="+", choices=TASKS, help="only cases of these tasks")
    parser.add_argument("--max-envs", type=int, help="only cases of at most so many environments")
    parser.add_argument("--again", action="store_true", help="measure anew what has been measured")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds of one case at most")
    parser.add_argument("--list", action="store_true", help="list the cases and stop")
    options = parser.parse_args(arguments)
    groups = options.only or [group for group in GROUPS if group != "peers" or options.peers]
    cases = [case for group in groups for case in GROUPS[group]() if fits(case, options)]
    if options.list or not cases:
        print("\n".join(case.key for case in cases) or "no case fits")
        return 0

    # A worker must not outlive this process and disturb the next one's measurements.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    machine = worker("machine.describe", {}, sys.executable, 300.0)["values"]
    file = options.output_dir / f"{file_stem(machine)}.json"
    results = Results(file, machine)
    todo = [case for case in cases if options.again or not results.has(case)]
    print(f"{len(todo)} of {len(cases)} cases are to be measured; results in {file}")
    failed = False
    try:
        with tqdm(todo, unit="case") as bar:
            for case in bar:
                bar.set_postfix_str(case.key)
                outcome = measure(case, options.timeout)
                failed |= outcome["status"] == "failed"
                results.add(case, outcome)
                tqdm.write(json.dumps({"case": case.key} | outcome))
    finally:
        if file.exists():
            report.write(file)
    return int(failed)


def fits(case: Case, options: argparse.Namespace) -> bool:
    """Whether the case is among those that the options ask for."""
    largest = max(case.arguments.get("sizes", [case.arguments.get("num_envs", 0)]))
    few = options.max_envs is None or largest <= options.max_envs
    return few and (not options.task or case.arguments.get("task") in options.task)


def measure(case: Case, timeout: float) -> dict[str, Any]:
    """The outcome of a case: its values, or why there are none."""
    started = time.perf_counter()
    try:
        python = peer_python(case.peer) if case.peer else sys.executable
        arguments = dict(case.arguments)
        if case.peer:
            arguments["cores"] = num_cores()
        if case.peer == "mujoco_warp":
            scene = worker("scene.describe", {"task": arguments["task"]}, sys.executable, timeout)
            arguments["scene"] = scene["values"]
        outcome = {"status": "ok"} | worker(case.measure, arguments, python, timeout)
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


def worker(measure: str, arguments: dict[str, Any], python: str, timeout: float) -> dict[str, Any]:
    """Runs one measurement in a process of its own.

    Raises:
        AbsentError: something to be measured is not here.
        KilledError: the system killed it.
        MemoryError: there was not enough.
        RuntimeError: it failed otherwise.
        subprocess.TimeoutExpired: it took too long.
    """
    where, name = measure.split(".")
    if where == "peers":
        script = str(Path(__file__).parent / "peers" / f"{name}.py")
        command = [python, script, json.dumps(arguments)]
    else:
        command = [python, "-m", "tests.benchmarks.worker", measure, json.dumps(arguments)]
    # Compilation is to be measured, and errors are to be told in their own words.
    environ = os.environ | {
        "JAX_ENABLE_COMPILATION_CACHE": "false",
        "JAX_TRACEBACK_FILTERING": "off",
    }
    if "num_devices" in arguments:
        flag = f"--xla_force_host_platform_device_count={arguments['num_devices']}"
        environ["XLA_FLAGS"] = f"{environ.get('XLA_FLAGS', '')} {flag}".strip()
    status, output, errors = run_alone(command, environ, timeout)
    if status == 0:
        try:
            return dict(json.loads(output.strip().splitlines()[-1]))
        except (ValueError, IndexError) as error:
            raise RuntimeError(f"its last line is no result: {output[-200:]!r}") from error
    lines = errors.strip().splitlines()
    why = lines[-1] if lines else f"exit status {status}"
    if status == -signal.SIGKILL:
        raise KilledError("killed by the system, most likely for its memory")
    if status == ABSENT:
        raise AbsentError(why)
    if any(word in errors.lower() for word in OUT_OF_MEMORY):
        raise MemoryError(why)
    raise RuntimeError("\n".join(lines[-20:]) or why)


def run_alone(command: list[str], environ: dict[str, str], timeout: float) -> tuple[int, str, str]:
    """Exit status, output and errors of a command; none of its processes outlives this call."""
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=environ,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            output, errors = process.communicate(timeout=timeout)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, output, errors


class Results:
    """What has been measured, in a JSON file that is written after every case."""

    def __init__(self, file: Path, machine: dict[str, Any]) -> None:
        self.file = file
        self.machine = hashlib.sha256(json.dumps(machine).encode()).hexdigest()[:8]
        self.kept: dict[str, Any] = {"machines": {}, "cases": {}}
        if file.exists():
            kept = json.loads(file.read_text())
            if not {"machines", "cases"} <= kept.keys():
                raise ValueError(f"{file} is not a result of this benchmark: move it away.")
            self.kept = kept
        self.kept["machines"][self.machine] = machine

    def has(self, case: Case) -> bool:
        """Whether there is nothing more to learn of the case on this machine."""
        known = self.kept["cases"].get(case.key, {})
        learned = known.get("status") in ("ok", "out of memory")
        return learned and known["machine"] == self.machine

    def add(self, case: Case, outcome: dict[str, Any]) -> None:
        """Keeps an outcome. The file is never half written."""
        self.kept["cases"][case.key] = {
            "group": case.group,
            "measure": case.measure,
            "arguments": dict(case.arguments),
            "machine": self.machine,
            "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
            **outcome,
        }
        cases = self.kept["cases"].values()
        used = {known["machine"] for known in cases}
        self.kept["machines"] = {k: v for k, v in self.kept["machines"].items() if k in used}
        self.file.parent.mkdir(parents=True, exist_ok=True)
        part = self.file.with_suffix(".part")
        part.write_text(json.dumps(self.kept, indent=1) + "\n")
        part.replace(self.file)


if __name__ == "__main__":
    sys.exit(main())
