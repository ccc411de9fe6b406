"""XLA compiler options for environments."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

from pixelbrax_jax.flags import is_guarded, under_default_flags
from pixelbrax_jax.validation import check_choice

_P = ParamSpec("_P")
_T = TypeVar("_T")

_WIDTH = "xla_cpu_prefer_vector_width"
_EMITTERS = "xla_cpu_use_fusion_emitters"
_COMMANDS = "xla_gpu_enable_command_buffer"
_CAPTURED = "FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
"""Operations that a GPU may capture in a CUDA graph: JAX 0.10.2's default and loops. Without loops
the host launches the parts of a step one by one. XLA ignores what a driver does not support."""

_PLATFORMS = {"cpu": "cpu", "gpu": "gpu", "cuda": "gpu", "rocm": "gpu", "tpu": "tpu"}
"""Platform of each accepted name: JAX's platforms and default backends."""

_MOST_INTERSECTIONS = 50
"""Largest number of intersections per pixel (geoms and planes of meshes, times rays: one to the
camera and one to each lamp) that XLA's newer emitters still compile to one fast loop."""


def compiler_options(env: Any = None, platform: str | None = None) -> dict[str, Any]:
    """Return options of ``jax.jit`` that make an environment fast.

    On a CPU with AVX-512 they enable vectors of 512 bits, with which the renderer is up to twice as
    fast; some physics adds options, and scenes with many geoms use XLA's older emitters. On a GPU
    they capture loops in CUDA graphs, so that the host launches a step of Brax's tasks at once. A
    TPU needs none.

    The Gymnasium, TorchRL and Stable-Baselines3 environments and the agents use these options. Pass
    them to the outermost ``jax.jit`` of your own program, the only one that takes options:

        step = jax.jit(env.step, compiler_options=pixelbrax_jax.compiler_options(env))

    Options change how XLA rounds, so results with and without them agree only to rounding errors.

    Args:
        env: a ``PixelEnv`` or ``VectorPixelEnv``; None for the renderer's options, which are all
            that Brax's tasks need.
        platform: ``cpu``, ``gpu`` (or ``cuda``, ``rocm``) or ``tpu``; None for the platform of the
            default device.

    Returns:
        The options that the installed XLA knows. The dictionary is empty if ``XLA_FLAGS`` sets
        ``xla_cpu_prefer_vector_width`` (CPU) or ``xla_gpu_enable_command_buffer`` (GPU); set the
        physics' options in ``XLA_FLAGS`` too in that case.

    Raises:
        ValueError: the platform is unknown.
    """
    if platform is None:
        platform = _default_platform()
    else:
        check_choice("platform", platform, _PLATFORMS)
    return _options(_physics(env), platform)


def jit(**options: Any) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorate like ``jax.jit``, with ``compiler_options``; the first argument is static.

    The options are those of this argument, an environment or an object whose ``env`` is one; for
    anything else, such as an agent, those without an environment. They are computed at the first
    call, because importing a package must not start a device.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        traced = under_default_flags(function)

        @cache
        def program(physics: Any, platform: str) -> Any:
            return jax.jit(traced, compiler_options=_options(physics, platform), **options)

        @wraps(function)
        def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            if is_guarded("host_to_device"):
                args, kwargs = jax.tree.map(_put, (args, kwargs))
            # JAX gives loop counters 64 bits if jax_enable_x64 is set while it lowers, after
            # `under_default_flags` has ended. XLA then rounds loops of convolutions differently.
            with jax.enable_x64(False):
                return program(_physics(args[0]), _default_platform())(*args, **kwargs)

        return call

    return decorate


def _put(leaf: Any) -> Any:
    """Put a NumPy array on the device explicitly, as ``jax.transfer_guard`` requires; 5x slower."""
    return jax.device_put(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def _physics(env: Any) -> Any:
    return getattr(getattr(env, "env", env), "physics", None)


def _default_platform() -> str:
    """Return the platform of JAX's default device, which ``jax.default_device`` may change."""
    device = getattr(jax.config, "jax_default_device", None)
    return getattr(device, "platform", device) or jax.default_backend()


def _options(physics: Any, platform: str) -> dict[str, Any]:
    platform = _PLATFORMS.get(platform, platform)
    flags = os.environ.get("XLA_FLAGS", "")
    if platform == "gpu" and _COMMANDS not in flags:
        chosen: dict[str, Any] = {_COMMANDS: _CAPTURED}
    elif platform == "cpu" and _WIDTH not in flags:
        chosen = {_WIDTH: 512}
        if physics is not None:
            chosen |= physics.compiler_options
            rays = 1 + len(physics.look.lamps if physics.look else ())
            shapes = len(physics.geoms.kind) + sum(physics.geoms.num_planes)
            if shapes * rays > _MOST_INTERSECTIONS:
                # The newer ones split long loops and compute shared values again in each part:
                # rendering DM Control's swimmer15 takes 250 times as long.
                chosen.setdefault(_EMITTERS, False)
    else:
        return {}
    return {name: value for name, value in chosen.items() if _is_known(name, value)}


@cache
def _is_known(option: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={option: value}).lower(0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
