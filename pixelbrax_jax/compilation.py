"""How XLA is asked to compile programs that draw images."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

from pixelbrax_jax._platform.lowering import default_platform
from pixelbrax_jax.flags import is_guarded, under_default_flags
from pixelbrax_jax.validation import check_choice

_P = ParamSpec("_P")
_T = TypeVar("_T")

_WIDTH = "xla_cpu_prefer_vector_width"
_EMITTERS = "xla_cpu_use_fusion_emitters"
_COMMANDS = "xla_gpu_enable_command_buffer"
_CAPTURED = "FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
"""What a GPU may have in a CUDA graph: the default of JAX 0.10.2 and loops, without which a step is
cut into parts that the host launches one after the other. XLA leaves out what a driver lacks."""

_PLATFORMS = {"cpu": "cpu", "gpu": "gpu", "cuda": "gpu", "rocm": "gpu", "tpu": "tpu"}
"""JAX's names of platforms, and those of its default backends."""

_MOST_INTERSECTIONS = 50
"""Geoms times rays of a pixel, one to the camera and one to each of the model's lamps, which XLA's
newer emitters still make one fast loop of."""


def compiler_options(env: Any = None, platform: str | None = None) -> dict[str, Any]:
    """Return options of ``jax.jit`` that make an environment fast.

    On a CPU: XLA holds back where there is AVX-512 and computes with vectors of 256 bits; with 512
    the ray-caster is up to twice as fast. CPUs without such vectors are not affected. Some physics
    is faster with options of its own, and scenes of many geoms are drawn faster with XLA's older
    emitters. On a GPU: loops of which all parts can be are captured in CUDA graphs, so that the
    host launches a step of Brax's tasks at once. A TPU needs none.

    Whatever PixelBrax compiles by itself for the Gymnasium, TorchRL and Stable-Baselines3
    environments and for its agents has these options. A program of your own gets them at its
    outermost ``jax.jit``, the only one that takes options:

        step = jax.jit(env.step, compiler_options=pixelbrax_jax.compiler_options(env))

    Options change how XLA rounds: the same program with and without them agrees to rounding
    errors, not to the bit.

    Args:
        env: a ``PixelEnv`` or ``VectorPixelEnv``; None for the options of the renderer alone,
            which are all that Brax's tasks have.
        platform: ``cpu``, ``gpu`` (or ``cuda``, ``rocm``) or ``tpu``, which the program is compiled
            for; None for that of the default device.

    Returns:
        The options. None of them if ``XLA_FLAGS`` name the width of vectors on a CPU
        (``xla_cpu_prefer_vector_width``; those of the physics are then yours to give too) or what
        is captured on a GPU (``xla_gpu_enable_command_buffer``). What the installed XLA does not
        know is left out.

    Raises:
        ValueError: there is no such platform.
    """
    return _options(_physics(env), platform)


def jit(
    env_of: Callable[[Any], Any], **options: Any
) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorate as ``jax.jit`` does, with ``compiler_options``.

    ``env_of`` gives the environment of the function's first argument, which is static. The options
    are asked for at the first call for a physics: importing a package must not start a device.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        traced = under_default_flags(function)

        @cache
        def program(physics: Any) -> Any:
            return jax.jit(traced, compiler_options=_options(physics), **options)

        @wraps(function)
        def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            if is_guarded("host_to_device"):
                args, kwargs = jax.tree.map(_put, (args, kwargs))
            return program(_physics(env_of(args[0])))(*args, **kwargs)

        return call

    return decorate


def _put(leaf: Any) -> Any:
    """Put a NumPy array on the device, in the way that ``jax.transfer_guard`` calls explicit.

    A compiled program does so itself in a fifth of the time, but implicitly.
    """
    return jax.device_put(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def _physics(env: Any) -> Any:
    return getattr(getattr(env, "env", env), "physics", None)


def _options(physics: Any, platform: str | None = None) -> dict[str, Any]:
    if platform is None:
        platform = default_platform()
    else:
        platform = _PLATFORMS[check_choice("platform", platform, _PLATFORMS)]
    flags = os.environ.get("XLA_FLAGS", "")
    if platform == "gpu" and _COMMANDS not in flags:
        chosen: dict[str, Any] = {_COMMANDS: _CAPTURED}
    elif platform == "cpu" and _WIDTH not in flags:
        chosen = {_WIDTH: 512, **(physics.compiler_options if physics else {})}
        if physics is not None and _intersections(physics) > _MOST_INTERSECTIONS:
            # The newer ones cut long loops up, and compute what the parts share again in each of
            # them: drawing DM Control's swimmer15 takes 250 times as long.
            chosen.setdefault(_EMITTERS, False)
    else:
        return {}
    return {name: value for name, value in chosen.items() if _is_known(name, value)}


def _intersections(physics: Any) -> int:
    return len(physics.geoms.kind) * (1 + len(physics.look.lamps if physics.look else ()))


@cache
def _is_known(option: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={option: value}).lower(0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
