"""Choices by platform, made when a program is lowered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax

_Function = TypeVar("_Function", bound=Callable[..., Any])


def by_platform(*args: Any, default: Callable[..., Any], **forms: Callable[..., Any]) -> Any:
    """Return the result of the function for the platform: one of ``forms``, or ``default``.

    ``forms`` are functions for ``cpu``, ``cuda``, ``rocm`` or ``tpu``, with results like those of
    ``default``. The choice is made when a program is lowered, even on a machine without the device.
    All functions are traced; trace what they share with ``trace_once`` if tracing is slow.
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
