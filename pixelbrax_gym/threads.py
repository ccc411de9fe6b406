"""Calls of compiled programs that run at the same time.

The runtime runs what one thread starts one after the other, on a CPU too, where XLA's programs of
small operations, such as physics, keep little more than one core busy. What several threads start
runs at the same time.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

_workers: list[ThreadPoolExecutor] = []
"""Of one thread each: calls that meet in a thread would run one after the other."""


def num_cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def call_on_threads(program: Callable, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
    """``program`` of the arguments of each call, started in a thread of its own.

    Args:
        program: a jitted function.
        calls: arguments of each call, all of the same shapes.

    Returns:
        What the calls return, in their order; it may still be computed.
    """
    # In the caller's own thread, where the program is compiled if it is new.
    first = program(*calls[0])
    while len(_workers) < len(calls) - 1:
        _workers.append(ThreadPoolExecutor(1, thread_name_prefix="pixelbrax"))
    device = jax.config.jax_default_device  # which a context may have set for this thread alone

    def call(arguments: tuple[Any, ...]) -> Any:
        with jax.default_device(device):
            return program(*arguments)

    others = [
        worker.submit(call, arguments)
        for worker, arguments in zip(_workers, calls[1:], strict=False)
    ]
    return [first, *(other.result() for other in others)]
