"""Measure run time without compilation, waiting for every result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from pixelbrax_jax.compilation import compiler_options

SECONDS = 90.0
"""Approximate total duration of a comparison."""
REPETITIONS = 5
REPETITION_SECONDS = 0.5
"""Minimum duration of a repetition."""

Name = TypeVar("Name")


def compiled(
    env: Any, function: Callable, *arguments: Any, **jit_options: Any
) -> tuple[Any, float]:
    """Return the compiled function and the seconds to trace and compile it."""
    started = time.perf_counter()
    jitted = jax.jit(function, compiler_options=compiler_options(env), **jit_options)
    program = jitted.lower(*arguments).compile()
    return program, time.perf_counter() - started


def rate(run: Callable[[int], Any], least_calls: int = 1) -> dict[str, float]:
    """Measure calls per second; ``run(n)`` makes n calls and returns arrays to wait for."""
    calls = least_calls
    _seconds(run, calls)
    while (seconds := _seconds(run, calls)) < REPETITION_SECONDS:
        wanted = 1.1 * REPETITION_SECONDS / max(seconds, 1e-6)
        calls = max(calls + 1, int(calls * min(10.0, wanted)))
    rates = [calls / _seconds(run, calls) for _ in range(REPETITIONS)]
    return {
        "median": float(np.median(rates)),
        "slowest": min(rates),
        "fastest": max(rates),
        "calls": calls,
    }


def _seconds(run: Callable[..., Any], *arguments: Any) -> float:
    started = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - started


def take_interleaved(
    runners: Mapping[Name, Callable[[], Any]], seconds: float = SECONDS
) -> dict[Name, list[float]]:
    """Measure each runner's seconds in 5 to 300 rounds, about ``seconds`` in total.

    Each round runs all in random order, so a slower machine affects all alike and ratios hold.
    """
    for run in runners.values():
        run()
    order, random = list(runners), np.random.default_rng(0)
    times: dict[Name, list[float]] = {name: [] for name in order}
    started, rounds = time.perf_counter(), 0
    while rounds < 5 or (rounds < 300 and time.perf_counter() - started < seconds):
        rounds += 1
        for place in random.permutation(len(order)):
            times[order[place]].append(_seconds(runners[order[place]]))
    return times


def speed_ratio(seconds: list[float], standard: list[float]) -> dict[str, Any]:
    """Compare a runner with a standard, round by round.

    Returns ``ratio``, the median over rounds, above 1 if the runner is faster; ``interval``, its
    95 % bootstrap interval; and ``runs``, the number of rounds.
    """
    ratios = np.divide(standard, seconds)
    drawn = np.random.default_rng(0).choice(ratios, (2000, len(ratios)))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return {
        "ratio": float(np.median(ratios)),
        "interval": [float(low), float(high)],
        "runs": len(seconds),
    }
