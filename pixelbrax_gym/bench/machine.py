"""Describe the machine that results are measured on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pixelbrax_jax.processor import describe_cpu

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


def installed_version(package: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


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
