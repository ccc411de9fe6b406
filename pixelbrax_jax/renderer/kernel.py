"""Whether programs for NVIDIA GPUs draw by the kernel of `pallas.py`, and why not."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import jax

_CAPABILITY = 8.0
"""Least compute capability for which XLA compiles such kernels: Ampere's."""

_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")


@cache
def obstacle() -> str | None:
    """Return why programs for CUDA, as lowered here, do without the kernel; None if they have it.

    Starts a device. What JAX computes on need not be a GPU: programs may be compiled for one ahead
    of time, where JAX's plugin for CUDA is installed.
    """
    if not _has_pallas():
        return f"jax {jax.__version__} has no Pallas for Triton"
    if jax.default_backend() != "gpu":
        if not any(map(find_spec, _PLUGINS)):
            return "JAX has no plugin for CUDA"
        return None
    device = jax.devices()[0]
    if "rocm" in getattr(device.client, "platform_version", "").lower():
        return "it is for CUDA, and JAX computes on ROCm"
    capability = str(getattr(device, "compute_capability", ""))
    try:
        fits = float(capability) >= _CAPABILITY
    except ValueError:
        fits = False
    if not fits:
        return (
            f"{device.device_kind} has compute capability {capability or 'unknown'}, and the kernel "
            f"needs {_CAPABILITY}"
        )
    return _unknown_card()


def _has_pallas() -> bool:
    try:
        from jax.experimental.pallas import triton
    except ImportError:
        return False
    return all(hasattr(triton, name) for name in ("CompilerParams", "load", "store"))


def _unknown_card() -> str | None:
    """Return what JAX's Pallas has against the card, from jax 0.12 on."""
    from jax.experimental.pallas import triton

    try:
        getattr(triton, "get_gpu_info", lambda: None)()
    except ValueError as error:
        return f"Pallas does not know the card: {error}"
    return None
