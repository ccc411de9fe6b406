"""Checks that arrays fit into memory, before they are allocated."""

from __future__ import annotations

import math
import os

import jax


def check_fits(what: str, num_bytes: float) -> None:
    """Raise MemoryError if the bytes exceed main memory; ``what`` names options and values."""
    limit = _main_memory()
    if num_bytes > limit:
        raise MemoryError(
            f"{what} would take at least {num_bytes / 1e9:,.1f} GB, and this machine has "
            f"{limit / 1e9:,.1f} GB of memory; lower one of them."
        )


def device_memory() -> float:
    """Return the bytes that JAX may use on its first device; infinite if unknown."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in statistics:
        return float(statistics["bytes_limit"])
    try:
        import psutil
    except ImportError:
        return math.inf
    return float(psutil.virtual_memory().available)


def _main_memory() -> float:
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return math.inf
