"""What every test runs under."""

import gc
import os

# Nothing here may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import jax
import pytest


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Forgets compiled programs where one folder of tests ends.

    Every program maps memory of its own, and a process may have some 65,000 maps on Linux
    (vm.max_map_count). The compiler crashes beyond them.
    """
    if nextitem is None or nextitem.path.parent != item.path.parent:
        jax.clear_caches()
        gc.collect()
