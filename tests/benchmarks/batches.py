"""Steps per second over the number of environments, interleaved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

import pixelbrax_jax as pb
from pixelbrax_gym.bench.adapters import scan
from pixelbrax_gym.bench.timing import SECONDS, speed_ratio, take_interleaved


def compare(task: str, sizes: Sequence[int], seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second over the number of environments; ``ratio`` is to the first."""
    action_size = pb.make(task)[0].action_size
    # 16 steps of the largest number: a call takes fresh memory, a tenth of the time of four steps.
    steps = 16 * math.lcm(*sizes)
    runners = {}
    for num_envs in sizes:
        shape = (steps // num_envs, num_envs, action_size)
        actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
        runners[num_envs] = scan(task, num_envs, actions)
    times = take_interleaved(runners, seconds)
    return [
        {
            "num_envs": num_envs,
            "steps_per_second": steps / float(np.median(runs)),
            **speed_ratio(runs, times[sizes[0]]),
            "runs": len(runs),
        }
        for num_envs, runs in times.items()
    ]
