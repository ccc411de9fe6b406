"""What every test runs under."""

import ctypes
import gc
import os
import signal
import time
from pathlib import Path

from tests.xla_flags import xla_flags

# Nothing here may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
# Compiled programs are kept for the next run, and shared between the tests' processes. A bound
# on the size makes JAX lock the folder while it reads and writes.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(2**30))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
# `make test-optimized` compiles as users do.
os.environ["XLA_FLAGS"] = " ".join(
    [
        xla_flags(optimize=os.environ.get("PIXELBRAX_TESTS_OPTIMIZE") == "1"),
        os.environ.get("XLA_FLAGS", ""),
    ]
)

# Under nohup and in the background they are ignored, by the programs that tests start as well.
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import jax
import pytest

# Tracing makes millions of objects that live on, and Python looks at all of them again and again.
gc.set_threshold(200_000, 20, 50)

MAX_MAPS = 45_000
"""Memory maps of this process beyond which compiled programs are forgotten."""
MAX_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4
"""Memory of this process beyond which they are forgotten, too. There are two workers."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run tests of one task one after the other: a process then traces its programs once."""

    def task(item: pytest.Item) -> str:
        parameters = getattr(item, "callspec", None)
        return str(parameters.params.get("task", "")) if parameters else ""

    items.sort(key=task)


_looked_at = 0.0


def pytest_runtest_teardown() -> None:
    """Forget compiled programs when there are too many; look at most once a second.

    Every program maps memory of its own, and a process may have some 65,000 maps on Linux
    (vm.max_map_count). The compiler crashes beyond them.
    """
    global _looked_at
    if (now := time.monotonic()) < _looked_at + 1.0:
        return
    maps, taken = memory_of_this_process()
    _looked_at = now
    if maps > MAX_MAPS or taken > MAX_BYTES:
        jax.clear_caches()
        gc.collect()
        # The C library keeps freed memory, and every later test would find too much.
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
            trim(0)


def memory_of_this_process() -> tuple[int, int]:
    """Memory maps and resident bytes; 0 where the system does not tell."""
    process = Path("/proc/self")
    if not (process / "maps").exists():
        return 0, 0
    pages = int((process / "statm").read_text().split()[1])
    return (process / "maps").read_bytes().count(b"\n"), pages * os.sysconf("SC_PAGE_SIZE")
