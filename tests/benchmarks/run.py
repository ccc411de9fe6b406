"""Measures everything, or parts of it, and writes JSON, a table and plots.

    python -m tests.benchmarks.run                      all; hours
    python -m tests.benchmarks.run --only renderer      one part; minutes
    python -m tests.benchmarks.run --only peers         others beside us, installed on first use

Each case runs in a process of its own: its peak memory is its own, and one that runs out of memory
or crashes is recorded as such while the rest goes on. What has been measured is kept; a
run that is cut short goes on where it stopped, and ``--again`` measures anew.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tests.benchmarks import report
from tests.benchmarks.cases import GROUPS, Case
from tests.benchmarks.peers.install import AbsentError, peer_python

ROOT = Path(__file__).parents[2]
OUT_OF_MEMORY = ("RESOURCE_EXHAUSTED", "Out of memory", "MemoryError", "bad_alloc")


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: of the command line; None means those of this process.

    Returns:
        The exit status: 1 if a case failed for another reason than memory or an absent peer.
    """
    parser = argparse.ArgumentParser(
        prog="pixelbrax bench", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--output-dir", type=Path, default=ROOT / "docs" / "benchmarks")
    parser.add_argument("--only", nargs="+", choices=GROUPS, help="parts to measure")
    parser.add_argument("--task", nargs="+", help="only cases of these tasks")
    parser.add_argument("--max-envs", type=int, help="only cases of at most so many environments")
    parser.add_argument("--again", action="store_true", help="measure anew what has been measured")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds of one case at most")
    parser.add_argument("--list", action="store_true", help="list the cases and stop")
    options = parser.parse_args(arguments)
    cases = [case for case in chosen(options.only or list(GROUPS)) if fits(case, options)]
    if options.list:
        print("\n".join(case.key for case in cases))
        return 0

    machine = worker("machine.describe", {}, sys.executable, 120.0)["values"]
    file = options.output_dir / f"{machine['platform']}.json"
    results = Results(file)
    todo = [case for case in cases if options.again or not results.has(case)]
    print(f"{len(todo)} of {len(cases)} cases are to be measured; results in {file}")
    failed = False
    with tqdm(todo, unit="case") as bar:
        for case in bar:
            bar.set_postfix_str(case.key)
            outcome = measure(case, options.timeout)
            failed |= outcome["status"] == "failed"
            results.add(case, outcome, machine)
            tqdm.write(json.dumps({"case": case.key} | outcome))
    report.write(file)
    return int(failed)


def chosen(groups: list[str]) -> list[Case]:
    """The cases of the groups."""
    return [case for group in groups for case in GROUPS[group]()]


def fits(case: Case, options: argparse.Namespace) -> bool:
    """Whether the case is among those that the options ask for."""
    task = case.arguments.get("task", case.arguments.get("domain"))
    few = options.max_envs is None or case.arguments.get("num_envs", 0) <= options.max_envs
    return few and (not options.task or task in options.task)


def measure(case: Case, timeout: float) -> dict[str, Any]:
    """The outcome of a case: its values, or why there are none."""
    started = time.perf_counter()
    try:
        python = peer_python(case.peer) if case.peer else sys.executable
        arguments = dict(case.arguments)
        if case.scene:
            described = worker("scene.describe", {"task": case.scene}, sys.executable, timeout)
            arguments["scene"] = described["values"]
        outcome = {"status": "ok"} | worker(case.measure, arguments, python, timeout)
    except AbsentError as error:
        outcome = {"status": "absent", "why": str(error)}
    except MemoryError as error:
        outcome = {"status": "out of memory", "why": str(error)}
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        outcome = {"status": "failed", "why": str(error)[-2000:]}
    outcome["seconds"] = round(time.perf_counter() - started, 1)
    return outcome


def worker(measure: str, arguments: dict[str, Any], python: str, timeout: float) -> dict[str, Any]:
    """Runs one measurement in a process of its own.

    Raises:
        AbsentError: the peer cannot run here.
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
    environ = dict(os.environ)
    if "num_devices" in arguments:
        flag = f"--xla_force_host_platform_device_count={arguments['num_devices']}"
        environ["XLA_FLAGS"] = f"{environ.get('XLA_FLAGS', '')} {flag}".strip()
    done = subprocess.run(
        command, cwd=ROOT, env=environ, capture_output=True, text=True, timeout=timeout, check=False
    )
    if done.returncode == 0:
        return dict(json.loads(done.stdout.strip().splitlines()[-1]))
    lines = done.stderr.strip().splitlines()
    why = lines[-1] if lines else f"exit status {done.returncode}"
    if done.returncode == -signal.SIGKILL or any(word in done.stderr for word in OUT_OF_MEMORY):
        raise MemoryError(why)
    if done.returncode == 3:
        raise AbsentError(why)
    raise RuntimeError(why)


class Results:
    """What has been measured, in a JSON file that is written after every case."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.cases: dict[str, Any] = {}
        if file.exists():
            self.cases = json.loads(file.read_text())["cases"]

    def has(self, case: Case) -> bool:
        """Whether there is nothing more to learn of the case."""
        return self.cases.get(case.key, {}).get("status") in ("ok", "out of memory")

    def add(self, case: Case, outcome: dict[str, Any], machine: dict[str, Any]) -> None:
        """Keeps an outcome. The file is never half written."""
        self.cases[case.key] = {
            "group": case.group,
            "measure": case.measure,
            "arguments": dict(case.arguments),
            "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
            **outcome,
        }
        self.file.parent.mkdir(parents=True, exist_ok=True)
        part = self.file.with_suffix(".part")
        part.write_text(json.dumps({"machine": machine, "cases": self.cases}, indent=1) + "\n")
        part.replace(self.file)


if __name__ == "__main__":
    sys.exit(main())
