"""What the peers' scripts have in common; it runs in their environments, which lack ours."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

REPETITIONS = 5

GYMNASIUM_IDS = {
    "halfcheetah": "HalfCheetah-v5",
    "walker2d": "Walker2d-v5",
    "ant": "Ant-v5",
    "humanoid": "Humanoid-v5",
}
"""Our task -> Gymnasium's, whose names EnvPool uses too."""


def speed_of(step: Callable[[], int], seconds: float) -> dict[str, float]:
    """Steps per second over repetitions of so many seconds, after one that warms up."""
    rates = []
    for repetition in range(1 + REPETITIONS):
        steps, started = 0, time.perf_counter()
        while time.perf_counter() - started < seconds:
            steps += step()
        if repetition:
            rates.append(steps / (time.perf_counter() - started))
    return {"median": float(np.median(rates)), "slowest": min(rates), "fastest": max(rates)}
