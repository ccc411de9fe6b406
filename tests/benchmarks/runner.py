"""Run cases in processes of their own: ``python -m tests.benchmarks.runner FUNCTION JSON``."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from tests.benchmarks.case import ABSENT, AbsentError, Case

OUT_OF_MEMORY = (
    "resource_exhausted",
    "out of memory",
    "out_of_memory",
    "memoryerror",
    "bad_alloc",
    "cannot allocate memory",
)


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
    return outcome_of(child.returncode, output, errors)


def outcome_of(status: int, output: str, errors: str) -> dict[str, Any]:
    """Return the outcome of a process that has ended with an exit status."""
    lines = errors.strip().splitlines()
    last = lines[-1] if lines else f"exit status {status}"
    if os.name == "posix" and status == -signal.SIGKILL:
        return {"status": "killed", "why": "by the system, probably because memory ran out"}
    if status == ABSENT:
        return {"status": "absent", "why": last}
    if status != 0:
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


def main() -> None:
    """Call a function with arguments, given as JSON, and write its result as a JSON line."""
    # JAX and PyTorch take turns on the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    module, _, function = sys.argv[1].rpartition(".")
    result = getattr(importlib.import_module(module), function)(**json.loads(sys.argv[2]))
    sys.stdout.write(json.dumps({"values": result, "peak_bytes": peak_bytes()}) + "\n")


def peak_bytes() -> dict[str, int | None]:
    """Return the peak memory of this process on host and device in bytes; None if unknown."""
    import jax

    device = jax.devices()[0].memory_stats() or {}
    host = None
    with suppress(ImportError):  # Windows
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        host = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"host": host, "device": device.get("peak_bytes_in_use")}


if __name__ == "__main__":
    main()
