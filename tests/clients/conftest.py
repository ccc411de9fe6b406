"""Other people's code on our environments. Collected only where it is asked for by name.

What is tested here is installed by `make test-clients` alone, so that `pytest` and `pytest tests`
leave this folder out; `pytest tests/clients` runs it, and a missing client is then an error.
"""

from __future__ import annotations

import os
from pathlib import Path

# Before torch and pygame are imported: PyTorch takes one thread, as two processes of tests share
# two cores with JAX, and windows need no screen.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import pytest

HERE = Path(__file__).parent


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leaves these files out unless the command line names them or their folder."""
    start = config.invocation_params.dir
    named = [(start / argument.split("::")[0]).resolve() for argument in config.args]
    return None if any(path.is_relative_to(HERE) for path in named) else True
