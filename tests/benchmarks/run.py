"""Throughput of the renderer and of the environments, as JSON and a plot.

    python -m tests.benchmarks.run --output-dir docs/benchmarks

Compile time is measured apart, every timed call is waited for, and a figure is the median of
several repetitions. Actions are random; episodes end and begin anew as they do in training.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

# JAX and PyTorch take turns on the same cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import gymnasium
import jax
import matplotlib
import numpy as np
import torch

import pixelbrax_gym
import pixelbrax_jax

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TASKS = {"halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant", "humanoid": "Humanoid"}
BATCHES = (1, 10, 100, 1000)
PACKAGES = ("jax", "brax", "gymnasium", "torch", "torchrl", "stable-baselines3", "pixelbrax")
REPETITIONS = 5
ROUNDS = 9


def compiled(function: Callable, *arguments: Any, **jit_options: Any) -> tuple[Any, float]:
    """The compiled program and the seconds it took to trace and compile."""
    started = time.perf_counter()
    program = jax.jit(function, **jit_options).lower(*arguments).compile()
    return program, time.perf_counter() - started


def seconds_per_call(call: Callable[[], Any], calls: int) -> float:
    """Median over repetitions of the mean time of ``calls`` calls, waited for."""
    jax.block_until_ready(call())
    times = []
    for _ in range(REPETITIONS):
        started = time.perf_counter()
        for _ in range(calls):
            result = call()
        jax.block_until_ready(result)
        times.append((time.perf_counter() - started) / calls)
    return float(np.median(times))


def renderer(look: str, *, shadows: bool = False, num_envs: int = 256, size: int = 84) -> dict:
    """Frames per second of the ray-caster alone: packed words from link poses."""
    env, params = pixelbrax_jax.make("ant", look=look, shadows=shadows, height=size, width=size)
    states = jax.jit(jax.vmap(env.physics.reset))(jax.random.split(jax.random.key(0), num_envs))
    draw = jax.vmap(env.draw, in_axes=(0, None))
    program, compile_seconds = compiled(draw, states, params)
    seconds = seconds_per_call(lambda: program(states, params), calls=10)
    memory, cost = program.memory_analysis(), program.cost_analysis() or {}
    return {
        "task": "ant",
        "look": look,
        "shadows": shadows,
        "num_envs": num_envs,
        "size": size,
        "frames_per_second": num_envs / seconds,
        "compile_seconds": compile_seconds,
        "temporary_bytes": memory.temp_size_in_bytes,
        "output_bytes": memory.output_size_in_bytes,
        "flops_per_frame": cost.get("flops", float("nan")) / num_envs,
        "bytes_accessed_per_frame": cost.get("bytes accessed", float("nan")) / num_envs,
    }


def renderer_reference(num_envs: int = 8, size: int = 84) -> dict:
    """The same figure for the plain ray-caster."""
    env, params = pixelbrax_jax.make("ant", renderer="reference", height=size, width=size)
    states = jax.jit(jax.vmap(env.physics.reset))(jax.random.split(jax.random.key(0), num_envs))
    program, compile_seconds = compiled(jax.vmap(env.draw, in_axes=(0, None)), states, params)
    seconds = seconds_per_call(lambda: program(states, params), calls=2)
    return {
        "num_envs": num_envs,
        "frames_per_second": num_envs / seconds,
        "compile_seconds": compile_seconds,
    }


def doors(num_envs: int, calls: int = 10) -> list[dict]:
    """Steps per second of every door to PyTorch, and of the functional environment in Python.

    All take turns, so that a change of the machine's mood strikes them alike; ``ratio`` is the
    median of a door's speed over that of the functional loop with the same autoreset mode.
    """
    action_size = pixelbrax_jax.make("ant")[0].action_size
    shape = (calls, num_envs, action_size)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    runners: dict[tuple[str, str], Callable[[], Any]] = {}
    for mode in ("next_step", "same_step"):
        runners["JAX loop", mode] = _jax_loop(num_envs, mode, actions)
    for output in ("jax", "torch", "numpy"):
        runners[f"Gymnasium, {output}", "next_step"] = _gymnasium(num_envs, output, actions)
    runners["TorchRL", "same_step"] = _torchrl(num_envs, actions)
    runners["Stable-Baselines3", "same_step"] = _sb3(num_envs, actions)
    times: dict[tuple[str, str], list[float]] = {key: [] for key in runners}
    for call in runners.values():
        call()
    for _ in range(ROUNDS):
        for key, call in runners.items():
            started = time.perf_counter()
            call()
            times[key].append((time.perf_counter() - started) / calls)
    return [
        {
            "door": name,
            "autoreset_mode": mode,
            "num_envs": num_envs,
            "steps_per_second": num_envs / float(np.median(seconds)),
            "ratio": float(np.median(np.divide(times["JAX loop", mode], seconds))),
        }
        for (name, mode), seconds in times.items()
    ]


def _jax_loop(num_envs: int, mode: str, actions: np.ndarray) -> Callable[[], Any]:
    env, params = pixelbrax_jax.make("ant")
    venv = pixelbrax_jax.VectorPixelEnv(env, num_envs, mode)
    step = jax.jit(lambda state, action: venv.step(state, action, params), donate_argnums=0)
    carry = {"state": venv.reset(jax.random.key(0), params)[0]}
    on_device = [jax.device_put(action) for action in actions]

    def call() -> Any:
        for action in on_device:
            carry["state"], timestep = step(carry["state"], action)
        return jax.block_until_ready(timestep)

    return call


def _gymnasium(num_envs: int, output: str, actions: np.ndarray) -> Callable[[], Any]:
    envs = gymnasium.make_vec("PixelBrax/Ant-v0", num_envs=num_envs, output=output)
    convert = {"jax": jax.device_put, "torch": torch.from_numpy, "numpy": np.asarray}[output]
    own = [convert(action) for action in actions]
    envs.reset(seed=0)

    def call() -> Any:
        for action in own:
            obs = envs.step(action)[0]
        # Tensors and NumPy arrays are complete when they are handed out.
        return jax.block_until_ready(obs) if output == "jax" else obs

    return call


def _torchrl(num_envs: int, actions: np.ndarray) -> Callable[[], Any]:
    env = pixelbrax_gym.PixelBraxTorchRLEnv("ant", num_envs)
    env.set_seed(0)
    env.reset()
    own = [env.full_action_spec.zero().set("action", torch.from_numpy(a)) for a in actions]

    def call() -> Any:
        for action in own:
            stepped = env._step(action)
            if stepped["done"].any():
                env._reset(stepped.select("done").set("_reset", stepped["done"]))
        return stepped

    return call


def _sb3(num_envs: int, actions: np.ndarray) -> Callable[[], Any]:
    env = pixelbrax_gym.PixelBraxSB3VecEnv("ant", num_envs)
    env.seed(0)
    env.reset()

    def call() -> Any:
        for action in actions:
            obs = env.step(action)[0]
        return obs

    return call


def environment(task: str, obs_mode: str, num_envs: int) -> dict:
    """Steps per second of the functional environment from a Python loop."""
    env, params = pixelbrax_jax.make(task, obs_mode=obs_mode)
    venv = pixelbrax_jax.VectorPixelEnv(env, num_envs)
    calls = 20 if num_envs <= 100 else 4
    shape = (calls, num_envs, env.action_size)
    actions = list(jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0))
    state, timestep = venv.reset(jax.random.key(0), params)

    def step(state, action, params):
        return venv.step(state, action, params)

    program, compile_seconds = compiled(step, state, actions[0], params, donate_argnums=0)
    carry = {"state": state}
    turn = iter(range(10**9))

    def call():
        carry["state"], timestep = program(carry["state"], actions[next(turn) % calls], params)
        return timestep

    seconds = seconds_per_call(call, calls)
    held = jax.tree.leaves((carry["state"], timestep))
    return {
        "task": task,
        "backend": env.physics.backend,
        "obs_mode": obs_mode,
        "num_envs": num_envs,
        "steps_per_second": num_envs / seconds,
        "compile_seconds": compile_seconds,
        "bytes_per_env": sum(leaf.nbytes for leaf in held) / num_envs,
        "temporary_bytes_per_env": program.memory_analysis().temp_size_in_bytes / num_envs,
    }


def plot(results: list[dict], path: Path) -> None:
    """Steps per second over the number of environments, one panel a task."""
    figure, panels = plt.subplots(
        1, len(TASKS), figsize=(13, 3.6), sharey=True, layout="constrained"
    )
    for panel, task in zip(panels, TASKS, strict=True):
        for obs_mode, label in (("pixels", "84 x 84 pixels, 3 frames"), ("state", "state only")):
            rows = [r for r in results if r["task"] == task and r["obs_mode"] == obs_mode]
            panel.loglog(
                [r["num_envs"] for r in rows],
                [r["steps_per_second"] for r in rows],
                marker="o",
                label=label,
            )
        backend = next(r["backend"] for r in results if r["task"] == task)
        panel.set(title=f"{TASKS[task]} ({backend})", xlabel="environments")
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("steps / s")
    panels[0].legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> dict:
    """Runs everything and writes ``<platform>.json`` and ``<platform>.png``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output-dir", default="docs/benchmarks")
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    options = parser.parse_args(arguments)
    output = Path(options.output_dir)
    output.mkdir(parents=True, exist_ok=True)

    device = jax.devices()[0]
    report: dict[str, Any] = {
        "device": device.device_kind,
        "platform": device.platform,
        "processor": _processor(),
        "cores": os.cpu_count(),
        "versions": {name: version(name) for name in PACKAGES},
        "python": platform.python_version(),
    }
    cases: list[tuple[str, Callable[[], dict | list[dict]]]] = [
        ("renderer", lambda: renderer("default")),
        ("renderer", lambda: renderer("original")),
        ("renderer", lambda: renderer("default", shadows=True)),
        ("renderer_reference", renderer_reference),
        ("doors", lambda: doors(256)),
    ]
    cases += [
        ("environment", lambda t=task, m=mode, n=n: environment(t, m, n))
        for task in TASKS
        for n in options.batches
        for mode in ("pixels", "state")
    ]
    for name, case in cases:
        results = case()
        for result in results if isinstance(results, list) else [results]:
            report.setdefault(name, []).append(result)
            print(json.dumps({"case": name} | result), flush=True)
        # After each case, so that a run that is cut short has not been for nothing.
        (output / f"{device.platform}.json").write_text(json.dumps(report, indent=2) + "\n")
        jax.clear_caches()
    plot(report["environment"], output / f"{device.platform}.png")
    print(f"Wrote {output / device.platform}.json and .png")
    return report


def _processor() -> str:
    """The processor's name where the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
