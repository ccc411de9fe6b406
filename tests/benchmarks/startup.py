"""Seconds from the import to the first frames."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from pixelbrax_jax.tasks import TASKS

SCRIPT = """
import json, time
marks = {}
started = time.perf_counter()

def mark(name):
    global started
    now = time.perf_counter()
    marks[name], started = now - started, time.perf_counter()

import gymnasium
import pixelbrax_gym
mark("import")
envs = gymnasium.make_vec("TASK", num_envs=16)
mark("make")
envs.reset(seed=0)
mark("first reset")
envs.step(envs.action_space.sample())
mark("first step")
again = gymnasium.make_vec("TASK", num_envs=16)
again.reset(seed=0)
again.step(again.action_space.sample())
mark("make, reset and step once more")
marks["import to first step"] = sum(list(marks.values())[:4])
import resource
marks["peak_bytes"] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps(marks))
"""


def first_frame(task: str, cache: str) -> dict[str, Any]:
    """Seconds of each stage with 16 environments behind Gymnasium, once.

    Args:
        task: the task.
        cache: JAX's persistent compilation cache: ``"none"``, ``"cold"`` (empty at the start)
            or ``"warm"`` (filled by an earlier process).
    """
    with tempfile.TemporaryDirectory() as folder:
        environ = with_cache(None if cache == "none" else folder)
        for _ in range(2 if cache == "warm" else 1):
            script = SCRIPT.replace("TASK", TASKS[task].gymnasium_id)
            marks = last_line(["-c", script], environ)
    return {"peak_bytes": marks.pop("peak_bytes"), "seconds": marks}


def with_cache(folder: str | None) -> dict[str, str]:
    """The variables of a process with a compilation cache in a folder, or without one."""
    ours = ("JAX_COMPILATION", "JAX_ENABLE_COMPILATION")
    environ = {k: v for k, v in os.environ.items() if not k.startswith(ours)}
    if folder is not None:
        environ["JAX_COMPILATION_CACHE_DIR"] = str(Path(folder) / "programs")
        environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"
    return environ


def last_line(arguments: list[str], environ: dict[str, str]) -> dict[str, Any]:
    """What a Python process of its own writes in its last line, as JSON.

    Raises:
        RuntimeError: it failed; the end of what it told.
    """
    done = subprocess.run(
        [sys.executable, *arguments], env=environ, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found
