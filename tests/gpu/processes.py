"""Programs of the tests in processes of their own, whose XLA reads other flags."""

from __future__ import annotations

import os
import subprocess
import sys

DETERMINISTIC = "--xla_gpu_deterministic_ops=true"


def deterministic() -> dict[str, str]:
    """The variables of a process that computes alike at every run."""
    flags = os.environ.get("XLA_FLAGS", "")
    return os.environ | {"XLA_FLAGS": f"{flags} {DETERMINISTIC}".strip()}


def told(code: str, environ: dict[str, str], timeout: float = 600.0) -> str:
    """What a Python program writes in its last line.

    Raises:
        AssertionError: it failed; the end of what it told.
    """
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(
        command, env=environ, capture_output=True, text=True, check=False, timeout=timeout
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip().splitlines()[-1]
