"""What figures are measured on."""

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
    """Return how many CPU cores this process may run on; quotas of containers are not seen."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe_cpu() -> dict[str, Any]:
    """The processor, without a device of JAX being made.

    Virtual machines name several generations alike; family and model tell them apart.
    """
    return {
        "processor": _from_cpuinfo("model name") or platform.processor() or platform.machine(),
        "family": _from_cpuinfo("cpu family"),
        "model": _from_cpuinfo("model"),
        "vectors": _vectors(),
        "cores": num_cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def describe() -> dict[str, Any]:
    """Device, processor and versions."""
    import jax

    device = jax.devices()[0]
    return {
        "platform": device.platform,
        "device": device.device_kind,
        "devices": jax.device_count(),
        "runtime": device.client.platform_version,
        **describe_cpu(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def file_stem(machine: dict[str, Any]) -> str:
    """Name of the files of results: CPUs with other vectors write into other files."""
    vectors: str = machine["vectors"] if machine["platform"] == "cpu" else ""
    return "-".join(filter(None, (machine["platform"], vectors.lower().replace("-", ""))))


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _vectors() -> str:
    """The widest vectors that the processor computes with, where the system tells.

    Virtual machines name processors of several generations alike, and images depend on it.
    """
    flags = _from_cpuinfo("flags").split()
    known = {"avx512f": "AVX-512", "avx2": "AVX2"}
    return next((name for flag, name in known.items() if flag in flags), "")


def _from_cpuinfo(entry: str) -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.partition(":")[0].strip() == entry:
                return line.partition(":")[2].strip()
    return ""
