"""The processor that computes."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any


def num_cores() -> int:
    """Return the number of CPU cores this process may use; ignores quotas of containers."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe_cpu() -> dict[str, Any]:
    """Describe the processor, without JAX; in virtual machines different ones share a name."""
    entries: dict[str, str] = {}
    if (cpuinfo := Path("/proc/cpuinfo")).exists():
        for line in reversed(cpuinfo.read_text().splitlines()):
            name, _, entry = line.partition(":")
            entries[name.strip()] = entry.strip()
    flags = entries.get("flags", "").split()
    widest = {"avx512f": "AVX-512", "avx2": "AVX2"}
    return {
        "processor": entries.get("model name") or platform.processor() or platform.machine(),
        "family": entries.get("cpu family", ""),
        "model": entries.get("model", ""),
        "vectors": next((name for flag, name in widest.items() if flag in flags), ""),
        "cores": num_cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def name_cpu() -> str:
    """Return the processor's name, vector extension and number of cores in one line."""
    found = describe_cpu()
    parts = (found["processor"], found["vectors"], f"{found['cores']} cores")
    return ", ".join(filter(None, parts))
