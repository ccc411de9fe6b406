"""Whether programs for NVIDIA GPUs draw by the kernel of `pallas.py`, and why not."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import jax

_CAPABILITY = 8.0
"""Least compute capability for which XLA compiles such kernels: Ampere's."""


def obstacle() -> str | None:
    """Return why programs for CUDA, as traced here, do without the kernel; None if they have it.

    Starts a device. What JAX computes on need not be a GPU: where its plugin for CUDA is installed,
    programs may be compiled for one ahead of time. jax 0.12.0.1 must then be told which, and
    0.10.2 need not; see `docs/renderer.md`.
    """
    backend = jax.default_backend()
    # Without a plugin nothing is imported or traced that only a GPU needs.
    if backend != "gpu" and not _has_plugin():
        return f"JAX computes on a {backend}"
    if backend == "gpu" and _is_rocm(jax.devices()[0]):
        return "JAX computes on ROCm, and the kernel is for NVIDIA GPUs"
    try:
        from jax.experimental.pallas import triton

        # jax 0.12.0.1 tells of an abstract or a real card; 0.10.2 has no such function.
        info = triton.get_gpu_info() if hasattr(triton, "get_gpu_info") else None
    except ImportError:
        return f"jax {jax.__version__} has no Pallas for Triton"
    except ValueError as error:
        return f"Pallas does not know the card: {error}"
    if info is not None:
        return _too_old("the card", info.compute_capability / 10)
    return _about(jax.devices()[0]) if backend == "gpu" else None


def auto_renderer() -> tuple[str, str]:
    """Return the renderer that ``"auto"`` stands for on JAX's default device, and why."""
    backend = jax.default_backend()
    if backend != "gpu":
        return "fused", f"JAX computes on a {backend}, and the kernel is for NVIDIA GPUs"
    why = obstacle()
    if why is not None:
        return "fused", f"not by one kernel: {why}"
    return "pallas", f"by one kernel, on {jax.devices()[0].device_kind}"


def _is_rocm(device: jax.Device) -> bool:
    return "rocm" in getattr(device.client, "platform_version", "").lower()


def _about(device: jax.Device) -> str | None:
    """Return what an NVIDIA GPU lacks."""
    capability = str(getattr(device, "compute_capability", ""))
    try:
        return _too_old(device.device_kind, float(capability))
    except ValueError:
        return f"the compute capability of {device.device_kind} is unknown: {capability!r}"


def _too_old(card: str, capability: float) -> str | None:
    if capability >= _CAPABILITY:
        return None
    return f"{card} has compute capability {capability}, and the kernel needs {_CAPABILITY}"


@cache
def _has_plugin() -> bool:
    return any(map(find_spec, ("jax_cuda12_plugin", "jax_cuda13_plugin")))
