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
from pixelbrax_jax import distractors

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TASKS = {"halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant", "humanoid": "Humanoid"}
BATCHES = (1, 10, 100, 1000)
PACKAGES = ("jax", "brax", "gymnasium", "torch", "torchrl", "stable-baselines3", "pixelbrax")
REPETITIONS = 5
ROUNDS = 9
TURNS = 25


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


def first_states(env: pixelbrax_jax.PixelEnv, params: Any, num_envs: int) -> Any:
    """States at the start of an episode, without key and frames, which drawing does not read."""
    keys = jax.random.split(jax.random.key(0), num_envs)
    begin = jax.jit(jax.vmap(lambda key: env.begin(key, jax.numpy.uint32(0), params)))
    return begin(keys).replace(key=None, frames=None)


def renderer(look: str, *, shadows: bool = False, num_envs: int = 256, size: int = 84) -> dict:
    """Frames per second of the ray-caster alone: packed words from link poses."""
    env, params = pixelbrax_jax.make("ant", look=look, shadows=shadows, height=size, width=size)
    states = first_states(env, params, num_envs)
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
    states = first_states(env, params, num_envs)
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
    median of a door's speed over that of the functional loop with the same autoreset mode that
    waits for each step as the door does. All see the same actions and the same episodes.
    """
    action_size = pixelbrax_jax.make("ant")[0].action_size
    shape = (calls, num_envs, action_size)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    runners: dict[tuple[str, str], Callable[[], Any]] = {}
    for mode in ("next_step", "same_step"):
        runners["JAX loop", mode] = _jax_loop(num_envs, mode, actions, waits=True)
        runners["JAX loop, never waiting", mode] = _jax_loop(num_envs, mode, actions, waits=False)
    for output in ("jax", "torch", "numpy"):
        runners[f"Gymnasium, {output}", "next_step"] = _gymnasium(num_envs, output, actions)
    runners["TorchRL, _step", "same_step"] = _torchrl(num_envs, actions, whole=False)
    runners["TorchRL, step_and_maybe_reset", "same_step"] = _torchrl(num_envs, actions, whole=True)
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


def _jax_loop(num_envs: int, mode: str, actions: np.ndarray, *, waits: bool) -> Callable[[], Any]:
    env, params = pixelbrax_jax.make("ant")
    params = jax.device_put(params)
    venv = pixelbrax_jax.VectorPixelEnv(env, num_envs, mode)
    step = jax.jit(venv.step, donate_argnums=0)
    keys = jax.vmap(jax.random.key)(jax.numpy.arange(num_envs))
    carry = {"state": venv.reset(keys, params)[0]}
    own = [jax.device_put(action) for action in actions]

    def call() -> Any:
        for action in own:
            carry["state"], timestep = step(carry["state"], action, params)
            if waits:
                jax.block_until_ready(timestep)
        return jax.block_until_ready(timestep)

    return call


def _gymnasium(num_envs: int, output: str, actions: np.ndarray) -> Callable[[], Any]:
    envs = gymnasium.make_vec("PixelBrax/Ant-v0", num_envs=num_envs, output=output)
    first, _ = envs.reset(seed=0)
    convert: dict[str, Callable[[np.ndarray], Any]] = {
        "jax": jax.device_put,
        "torch": lambda action: torch.from_numpy(action).to(first.device),
        "numpy": np.asarray,
    }
    own = [convert[output](action) for action in actions]

    def call() -> Any:
        for action in own:
            obs = envs.step(action)[0]
            if output == "jax":
                jax.block_until_ready(obs)
            elif output == "torch":
                _wait_for_torch()
        return obs

    return call


def _torchrl(num_envs: int, actions: np.ndarray, *, whole: bool) -> Callable[[], Any]:
    env = pixelbrax_gym.PixelBraxTorchRLEnv("ant", num_envs)
    env.set_seed(0)
    carry = {"td": env.reset()}
    own = [torch.from_numpy(action).to(env.device) for action in actions]

    def call() -> Any:
        for action in own:
            td = carry["td"].set("action", action)
            if whole:
                _, carry["td"] = env.step_and_maybe_reset(td)
            else:
                stepped = env._step(td)
                if stepped["done"].any():
                    stepped = env._reset(stepped.select("done").set("_reset", stepped["done"]))
                carry["td"] = stepped
            _wait_for_torch()
        return carry["td"]

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


def _wait_for_torch() -> None:
    """On a CPU a tensor is complete when it is handed out."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


DISTRACTORS = {
    "none": (),
    "color, each frame": (distractors.Color(),),
    "color, each material": (distractors.Color("geom", "walk", 0.2, "uniform"),),
    "video overlay": (distractors.Video(mode="overlay"),),
    "video background": (distractors.Video(ground_alpha=0.3),),
    "camera": (distractors.Camera(scale=0.2),),
    "all three": (
        distractors.Color(),
        distractors.Video(ground_alpha=0.3),
        distractors.Camera(scale=0.2),
    ),
}


def synthetic_bank(size: int = 84) -> distractors.ClipBank:
    """As many frames as DAVIS-2017's training split has at most: 60 clips of 70."""
    frames = np.random.default_rng(0).integers(0, 256, (60 * 70, size, size, 3), dtype=np.uint8)
    length = np.full(60, 70, np.int32)
    return distractors.ClipBank(frames, length, tuple(map(str, range(60))), "noise", "train")


def distractor_costs(num_envs: int) -> list[dict]:
    """Steps per second with and without distractors, all taking turns.

    What else goes on in a machine disturbs runs by more than distractors cost. So there are two
    ratios: of the medians, and of the fastest runs, which were disturbed least.
    """
    calls = max(1, 2048 // num_envs)
    bank = synthetic_bank()
    started = time.perf_counter()
    jax.block_until_ready(bank.to_device().words)
    upload_seconds = time.perf_counter() - started
    runners, times = {}, {}
    for name, links in DISTRACTORS.items():
        plays = any(isinstance(link, distractors.Video) for link in links)
        env, params = pixelbrax_jax.make("ant", distractors=links, clips=bank if plays else None)
        runners[name] = _stepper(env, jax.device_put(params), num_envs, calls)
        times[name] = []
        runners[name]()
    for _ in range(TURNS):
        for name, call in runners.items():
            started = time.perf_counter()
            call()
            times[name].append((time.perf_counter() - started) / calls)
    clean = times["none"]
    return [
        {
            "distractors": name,
            "num_envs": num_envs,
            "steps_per_second": num_envs / float(np.median(seconds)),
            "ratio": float(np.median(clean) / np.median(seconds)),
            "ratio_of_fastest": min(clean) / min(seconds),
            "bank_bytes": bank.device_bytes,
            "bank_upload_seconds": upload_seconds,
        }
        for name, seconds in times.items()
    ]


def _stepper(env: Any, params: Any, num_envs: int, calls: int) -> Callable[[], Any]:
    venv = pixelbrax_jax.VectorPixelEnv(env, num_envs)
    step = jax.jit(venv.step, donate_argnums=0)
    shape = (calls, num_envs, env.action_size)
    actions = list(jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0))
    carry = {"state": venv.reset(jax.random.key(0), params)[0]}

    def call() -> Any:
        for action in actions:
            carry["state"], timestep = step(carry["state"], action, params)
        return jax.block_until_ready(timestep)

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
    parser.add_argument(
        "--only", nargs="+", help="cases to measure anew; the others stay as they are in the JSON"
    )
    options = parser.parse_args(arguments)
    output = Path(options.output_dir)
    output.mkdir(parents=True, exist_ok=True)

    device = jax.devices()[0]
    file = output / f"{device.platform}.json"
    kept = json.loads(file.read_text()) if options.only and file.exists() else {}
    report: dict[str, Any] = {k: v for k, v in kept.items() if k not in (options.only or ())}
    report |= {
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
        ("distractors", lambda: distractor_costs(256)),
        ("distractors", lambda: distractor_costs(1024)),
    ]
    cases += [
        ("environment", lambda t=task, m=mode, n=n: environment(t, m, n))
        for task in TASKS
        for n in options.batches
        for mode in ("pixels", "state")
    ]
    for name, case in cases:
        if options.only and name not in options.only:
            continue
        results = case()
        for result in results if isinstance(results, list) else [results]:
            report.setdefault(name, []).append(result)
            print(json.dumps({"case": name} | result), flush=True)
        # After each case, so that a run that is cut short has not been for nothing.
        file.write_text(json.dumps(report, indent=2) + "\n")
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
