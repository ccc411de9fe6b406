"""Training on one device and on several."""

from __future__ import annotations

import os
import sys
from typing import Any

import jax

from pixelbrax_gym.bench.throughput import compiled, rate
from pixelbrax_jax.agents.config import make_env
from pixelbrax_jax.agents.on_policy.ppo import PPO
from pixelbrax_jax.agents.presets import preset
from pixelbrax_jax.agents.runner.devices import replicate, state_shardings
from pixelbrax_jax.envs.sharded import ShardedVectorEnv, make_env_mesh
from tests.benchmarks.case import ABSENT


def training(task: str, num_devices: int, cores: int, num_envs: int) -> dict[str, Any]:
    """Iterations of PPO's preset ``ci`` with environments spread over emulated devices."""
    allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else []
    if len(allowed) < cores:
        sys.stderr.write(f"there are {len(allowed)} cores to choose from, not {cores}\n")
        sys.exit(ABSENT)
    # Before JAX makes its threads.
    os.sched_setaffinity(0, allowed[:cores])
    config = preset("ppo", "ci", task, num_envs=num_envs)
    env, params = make_env(config)
    mesh = make_env_mesh(num_devices)
    algorithm = PPO(config, ShardedVectorEnv(env, num_envs, mesh))  # type: ignore[arg-type]
    key = jax.random.key(0)
    params = replicate(mesh, params)
    shardings = state_shardings(mesh, jax.eval_shape(algorithm.init, key, params))
    init = jax.jit(lambda params: algorithm.init(key, params), out_shardings=shardings)
    state = init(params)
    iterate, compile_seconds = compiled(env, algorithm.iterate, state, params, donate_argnums=0)
    carry = {"state": state}
    del state

    def run(calls: int) -> Any:
        for _ in range(calls):
            carry["state"], metrics = iterate(carry["state"], params)
        return metrics

    speed = rate(run)
    return {
        "steps_per_second": speed["median"] * config.steps_per_iteration,
        "speed": speed,
        "compile_seconds": compile_seconds,
    }
