"""Adapters beside the JAX loop, and whether torch's tensors are JAX's buffers."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import gymnasium

from pixelbrax_gym.bench.adapters import adapter_runs, compare_runs
from pixelbrax_jax.tasks import TASKS


def compare(task: str, num_envs: int, seconds: float) -> Callable[[float], dict[str, Any]]:
    """Compare the adapters with the JAX loop, and pointers of frames, rewards and actions.

    ``shared`` is whether each has one address in both libraries; empty without torch.
    """
    shared = pointers(task, num_envs) if find_spec("torch") else {}
    runs, steps = adapter_runs(task, num_envs)
    for run in runs.values():
        run()
    return lambda _: {"shared": shared, "adapters": compare_runs(runs, steps, seconds)}


def pointers(task: str, num_envs: int) -> dict[str, bool]:
    """Return whether torch's tensors of a step have the addresses of the arrays that JAX computed.

    ``back`` is a tensor that JAX takes over.
    """
    import jax
    import torch

    envs = gymnasium.make_vec(TASKS[task].gymnasium_id, num_envs=num_envs, output="torch")
    obs, _ = envs.reset(seed=0)
    computed, step = [], envs._stateful.step
    envs._stateful.step = lambda action: computed.append(step(action)) or computed[-1]
    obs, reward, *_ = envs.step(torch.zeros(envs.action_space.shape, device=obs.device))
    back = jax.dlpack.from_dlpack(reward)
    arrays = computed[-1]
    found = {
        "frames": obs.data_ptr() == arrays["obs"].unsafe_buffer_pointer(),
        "back": back.unsafe_buffer_pointer() == reward.data_ptr(),
    }
    envs.close()
    return found
