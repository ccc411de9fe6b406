"""Steps per second over the number of environments, interleaved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pixelbrax_jax as pb
from pixelbrax_gym.bench.adapters import SECONDS, compare_speeds, random_actions, scan


def compare(task: str, sizes: Sequence[int], seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second over the number of environments; ``ratio`` is to the first."""
    action_size = pb.make(task)[0].action_size
    # 16 steps of the largest number: a call takes fresh memory, a tenth of the time of four steps.
    steps = 16 * math.lcm(*sizes)
    runs = {
        num_envs: scan(task, num_envs, random_actions(steps // num_envs, num_envs, action_size))
        for num_envs in sizes
    }
    found = compare_speeds(runs, steps, lambda _: sizes[0], seconds)
    return [{"num_envs": num_envs, **speed} for num_envs, speed in found.items()]
