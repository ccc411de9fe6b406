"""What learning costs beside the simulator: training steps per second of each encoder, as JSON.

    python -m tests.benchmarks.training --output docs/benchmarks/training.json

PPO on HalfCheetah at 84 x 84 with three frames, actor and critic with one encoder, the settings'
defaults else; the environments alone are stepped in the same process, with drawn actions.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pixelbrax_jax import VectorPixelEnv, compiler_options
from pixelbrax_jax.agents.config import make_env
from pixelbrax_jax.agents.networks.actor import ENCODERS
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.config import EnvConfig

REPETITIONS = 5


def measure(encoder: str, num_envs: int, num_steps: int) -> dict[str, Any]:
    """Steps per second of training and of the environments alone, taking turns."""
    config = PPOConfig(
        env=EnvConfig(task="halfcheetah"),
        encoder=encoder,
        layout="shared",
        num_envs=num_envs,
        num_steps=num_steps,
        num_minibatches=4,
    )
    env, params = make_env(config)
    envs = VectorPixelEnv(env, num_envs)
    algorithm = PPO(config, envs)
    carry = {"train": jax.jit(algorithm.init)(jax.random.key(0), params)}
    carry["play"] = carry["train"].env_state

    def play(state: Any, params: Any) -> tuple[Any, Any]:
        def step(state: Any, key: jax.Array) -> tuple[Any, Any]:
            action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0)
            state, timestep = envs.step(state, action, params)
            return state, timestep.reward

        return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), num_steps))

    programs, compile_seconds, times = {}, {}, {"train": [], "play": []}
    for name, function in (("train", algorithm.iterate), ("play", play)):
        started = time.perf_counter()
        compiled = jax.jit(function, compiler_options=compiler_options(env))
        programs[name] = compiled.lower(carry[name], params).compile()
        compile_seconds[name] = time.perf_counter() - started
        jax.block_until_ready(programs[name](carry[name], params))
    for _ in range(REPETITIONS):
        for name, program in programs.items():
            started = time.perf_counter()
            carry[name], _ = jax.block_until_ready(program(carry[name], params))
            times[name].append(time.perf_counter() - started)
    speed = {n: num_envs * num_steps / float(np.median(t)) for n, t in times.items()}
    return {
        "encoder": encoder,
        "num_envs": num_envs,
        "num_steps": num_steps,
        "parameters": sum(x.size for x in jax.tree.leaves(carry["train"].networks)),
        "compile_seconds": compile_seconds["train"],
        "train_steps_per_second": speed["train"],
        "env_steps_per_second": speed["play"],
        "ratio": speed["train"] / speed["play"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=16)
    parser.add_argument("--encoders", nargs="+", choices=ENCODERS, default=list(ENCODERS))
    options = parser.parse_args()
    about = {name: version(name) for name in ("jax", "brax", "pixelbrax")}
    about |= {"machine": platform.machine(), "device": jax.devices()[0].device_kind}
    rows = []
    for encoder in options.encoders:
        rows.append(measure(encoder, options.num_envs, options.num_steps))
        print(json.dumps(rows[-1]), flush=True)
        report = {"about": about, "encoders": rows}
        options.output.write_text(json.dumps(report, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
