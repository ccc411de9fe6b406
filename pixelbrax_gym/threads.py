"""Calls of a compiled program that run at the same time.

The runtime runs what one thread starts one after the other, on a CPU too, where XLA's programs of
small operations, such as physics, do not keep all cores busy. What several threads start runs at
the same time.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

_workers: list[ThreadPoolExecutor] = []
"""Of one thread each, so that the shares of a batch never meet in a thread."""


def num_cores() -> int:
    """CPU cores that this process may run on; quotas of containers are not seen."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def call_on_threads(program: Callable, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
    """``program`` of the arguments of each call, in as many threads as there are cores at most.

    Args:
        program: a compiled function. One that is only jitted would be compiled in every thread
            whose contexts, such as ``jax.default_matmul_precision``, are not the caller's.
        calls: arguments of each call.

    Returns:
        What the calls return, in their order; arrays may not be ready yet.

    Raises:
        Exception: of a call that failed, the caller's thread first. No thread is still at it, and
            calls that the failed one's thread had left are not made.
    """
    num_threads = min(num_cores(), len(calls))
    while len(_workers) < num_threads - 1:
        _workers.append(ThreadPoolExecutor(1, thread_name_prefix="pixelbrax"))

    def call_share(first: int) -> list[Any]:
        return [program(*arguments) for arguments in calls[first::num_threads]]

    others = [_workers[i - 1].submit(call_share, i) for i in range(1, num_threads)]
    results: list[Any] = [None] * len(calls)
    try:
        results[::num_threads] = call_share(0)
    finally:
        wait(others)
    for first, other in enumerate(others, 1):
        results[first::num_threads] = other.result()
    return results
