"""What a program does on each platform, decided when it is lowered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax

_Function = TypeVar("_Function", bound=Callable[..., Any])


def by_platform(*args: Any, default: Callable[..., Any], **forms: Callable[..., Any]) -> Any:
    """Return what the function for a platform gives.

    The choice is made when a program is lowered: one that is lowered for a GPU is that of a GPU,
    also on a machine without one. All functions are traced, and one is lowered. Where tracing
    takes long, trace what they share once, by ``trace_once``.

    Args:
        *args: trees of arrays, for all functions.
        default: what is computed on all other platforms.
        **forms: other functions by platform: ``cpu``, ``cuda``, ``rocm`` or ``tpu``. Their results
            have the tree, shapes and dtypes of those of ``default``.
    """
    return jax.lax.platform_dependent(*args, default=default, **forms)


def trace_once(function: _Function) -> _Function:
    """Return a function that is traced once and written out wherever it is called."""
    return jax.jit(function, inline=True)  # type: ignore[return-value]


def default_platform() -> str:
    """Return ``cpu``, ``gpu`` or ``tpu``: where JAX computes by default.

    For compiler options and messages, never for what a program computes. It starts the device.
    """
    return jax.default_backend()
