"""Whole programs with a time limit: a training run, and the tests of the GPU."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from pixelbrax_jax.processor import num_cores
from tests.benchmarks.case import AbsentError

FOLDER = "PIXELBRAX_REPORT_FOLDER"
"""Variable with the folder for what programs write."""

STOPPING = 12.0
"""Seconds before its limit at which a program is asked to stop."""

COVERED = "kernel_draws_what_the_plain or learns_to_balance"
"""Tests of what other parts of the report show; they take minutes."""

_OUTCOME = re.compile(r"\b(PASSED|FAILED|ERROR|SKIPPED|XFAIL)\b")
_TEST = re.compile(r"tests/gpu/\S+")


class Ended(NamedTuple):
    """What a program wrote, and its exit status; None if it was stopped at its limit."""

    text: str
    status: int | None


def run_program(command: Sequence[str], seconds: float, environ: Mapping[str, str]) -> Ended:
    """Run a program; at the limit it gets SIGINT, and later SIGKILL."""
    with subprocess.Popen(
        command,
        env=os.environ | environ,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as child:
        asked = False
        try:
            told, _ = child.communicate(timeout=max(1.0, seconds - STOPPING))
        except subprocess.TimeoutExpired:
            asked = True
            child.send_signal(signal.SIGINT)
            try:
                told, _ = child.communicate(timeout=STOPPING)
            except subprocess.TimeoutExpired:
                child.kill()
                told, _ = child.communicate()
    return Ended(told, None if asked else child.returncode)


def learning(
    algorithm: str, preset: str, task: str, options: Sequence[str]
) -> Callable[[float], dict[str, Any]]:
    """Train for so many seconds, compilation included; returns of training episodes over time.

    ``curve`` has seconds since the first update, control steps and return.
    """
    folder = Path(os.environ[FOLDER]) / f"{algorithm}-{task}"
    command = [sys.executable, "-m", "pixelbrax_gym.cli", "--keep-no-programs", "train", algorithm]
    command += ["--preset", preset, "--task", task, "--no-progress", *options]
    command += ["--output-dir", str(folder), "--resume", "never"]

    def timed(seconds: float) -> dict[str, Any]:
        from pixelbrax_jax.agents.runner.metrics import read_metrics

        metrics = folder / "metrics.jsonl"
        shutil.rmtree(folder, ignore_errors=True)  # of a call that was cut short
        told, status = run_program(command, seconds, {})
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "log.txt").write_text(told, "utf-8")
        if status or not metrics.exists():
            raise RuntimeError(told[-2000:] or "it made no update within its time")
        return {"command": " ".join(command[1:]), "limit": seconds, **curve(read_metrics(metrics))}

    return timed


def curve(records: list[dict[str, float]]) -> dict[str, Any]:
    """Return at most 200 points of a run's returns, and its steps per second at the end."""
    points = [(r["seconds"], r["steps"], r["episode/return"]) for r in records
              if "episode/return" in r]  # fmt: skip
    if not records:
        raise RuntimeError("it made no update within its time")
    kept = points[:: max(1, len(points) // 200)]
    first, last = records[0], records[-1]
    taken = last["seconds"] - first["seconds"]
    return {
        "curve": kept,
        "steps": last["steps"],
        "seconds": last["seconds"],
        "first_update_seconds": first["seconds"],
        "steps_per_second": (last["steps"] - first["steps"]) / taken if taken else None,
    }


def tests(arguments: Sequence[str]) -> Callable[[float], dict[str, Any]]:
    """Run the tests marked ``gpu``, except those of what other parts show; count the outcomes."""
    missing = [name for name in ("pytest", "torch") if not find_spec(name)]
    if missing:
        raise AbsentError(f'{" and ".join(missing)} not installed: pip install -e ".[dev]"')
    command = [sys.executable, "-m", "pytest", "-v", "-m", "gpu", "-p", "no:cacheprovider"]
    if find_spec("xdist"):
        command += ["-n", str(max(1, min(6, num_cores() // 3)))]
    command += list(arguments) or ["tests/gpu", "-k", f"not ({COVERED})"]
    environ = {
        "PIXELBRAX_TESTS_DEVICE": "cpu" if os.environ.get("JAX_PLATFORMS") == "cpu" else "cuda",
        "PIXELBRAX_TESTS_OPTIMIZE": "1",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_deterministic_ops=true".strip(),
    }

    def timed(seconds: float) -> dict[str, Any]:
        told, _ = run_program(command, seconds, environ)
        (Path(os.environ[FOLDER]) / "tests.log").write_text(told, "utf-8")
        found = count_tests(told)
        if not found["counts"]:
            raise RuntimeError(told[-2000:])
        return found

    return timed


def count_tests(log: str) -> dict[str, Any]:
    """Count the outcomes in pytest's verbose log, which may have been cut short."""
    counts: Counter[str] = Counter()
    failed = []
    for line in log.partition("short test summary")[0].splitlines():
        outcome, name = _OUTCOME.search(line), _TEST.search(line)
        if outcome and name:
            counts[outcome[1].lower()] += 1
            if outcome[1] in ("FAILED", "ERROR"):
                failed.append(name[0])
    done = re.search(r"=+ (.*\b(?:passed|failed|error)\b.*) =+\s*$", log.strip())
    return {"counts": dict(counts), "failed": failed, "finished": done[1] if done else None}
