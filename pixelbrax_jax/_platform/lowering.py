"""Choices by platform, made when a program is lowered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax

_Function = TypeVar("_Function", bound=Callable[..., Any])


def by_platform(*args: Any, default: Callable[..., Any], **forms: Callable[..., Any]) -> Any:
    """Return the result of the function for the platform.

    The choice is made when a program is lowered, so a program that is lowered for a GPU has the
    GPU's form even on a machine without one. All functions are traced, and one is lowered. Trace
    what they share with ``trace_once`` if tracing is slow.

    Args:
        *args: trees of arrays, for all functions.
        default: the function for all other platforms.
        **forms: functions by platform: ``cpu``, ``cuda``, ``rocm`` or ``tpu``. Their results have
            the tree, shapes and dtypes of those of ``default``.
    """
    return jax.lax.platform_dependent(*args, default=default, **forms)


def trace_once(function: _Function) -> _Function:
    """Return a function that is traced once and inlined wherever it is called."""
    return jax.jit(function, inline=True)  # type: ignore[return-value]


def default_platform() -> str:
    """Return JAX's default platform, ``cpu``, ``gpu`` or ``tpu``; starts the device.

    Use it for compiler options and messages, never for what a program computes.
    """
    return jax.default_backend()
