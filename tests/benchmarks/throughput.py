"""Gymnasium's vector environments, in the way that peers are measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import make_vec

import pixelbrax_gym  # noqa: F401  # registers the ids
import pixelbrax_jax as pb
from pixelbrax_gym.bench.throughput import rate
from pixelbrax_jax.tasks import TASKS


def gymnasium(task: str, num_envs: int) -> dict[str, Any]:
    """Steps per second with NumPy output."""
    envs = make_vec(TASKS[task].gymnasium_id, num_envs=num_envs, output="numpy")
    envs.reset(seed=0)
    draw = np.random.default_rng(0)
    shape = envs.action_space.shape

    def run(calls: int) -> Any:
        for _ in range(calls):
            obs = envs.step(draw.uniform(-1.0, 1.0, shape).astype(np.float32))[0]
        return obs

    speed = rate(run)
    return {
        "steps_per_second": num_envs * speed["median"],
        "speed": speed,
        "control_dt": pb.make(task)[0].dt,
    }
