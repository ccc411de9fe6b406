"""Describe the machine that results are measured on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = (
    "pixelbrax",
    "jax",
    "jaxlib",
    "brax",
    "mujoco",
    "gymnasium",
    "torch",
    "torchrl",
    "stable-baselines3",
    "numpy",
)


def num_cores() -> int:
    """Return the number of CPU cores this process may use; ignores quotas of containers."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def installed_version(package: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def describe_cpu() -> dict[str, Any]:
    """Return the processor's description without starting JAX.

    ``family``, ``model`` and ``vectors`` tell apart generations that share a name in virtual
    machines.
    """
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


def describe() -> dict[str, Any]:
    """Return device, processor, versions and XLA flags."""
    import jax

    device = jax.devices()[0]
    return {
        "platform": device.platform,
        "device": device.device_kind,
        "devices": jax.device_count(),
        "runtime": device.client.platform_version,
        **describe_cpu(),
        "python": platform.python_version(),
        "versions": {name: installed_version(name) for name in PACKAGES},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def file_stem(machine: dict[str, Any]) -> str:
    """Return the stem of the result files: the platform, and the vector extension of a CPU."""
    vectors: str = machine["vectors"] if machine["platform"] == "cpu" else ""
    return "-".join(filter(None, (machine["platform"], vectors.lower().replace("-", ""))))
