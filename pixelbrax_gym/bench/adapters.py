"""Compare the adapters to Gymnasium, TorchRL and Stable-Baselines3 in interleaved runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any, TypeVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import pixelbrax_gym
import pixelbrax_jax as pb
from pixelbrax_gym.bench.throughput import seconds_of
from pixelbrax_jax.tasks import TASKS

SECONDS = 90.0
"""Approximate total duration of a comparison."""

Name = TypeVar("Name")
Run = Callable[[], Any]
"""Takes some steps and waits for their results."""


def compare_speeds(
    runs: Mapping[Name, Run], steps: int, standard: Callable[[Name], Name], seconds: float = SECONDS
) -> dict[Name, dict[str, Any]]:
    """Compare runs of ``steps`` steps in 5 to 300 rounds, about ``seconds`` in total.

    Each round runs all in random order, so a slower machine affects all alike. Results by name are
    ``steps_per_second``; ``ratio``, the median over rounds of its speed to that of the name's
    ``standard``; ``interval``, its 95 % bootstrap interval; and ``runs``, the number of rounds.
    """
    for run in runs.values():
        run()
    order, random = list(runs), np.random.default_rng(0)
    times: dict[Name, list[float]] = {name: [] for name in order}
    started, rounds = time.perf_counter(), 0
    while rounds < 5 or (rounds < 300 and time.perf_counter() - started < seconds):
        rounds += 1
        for place in random.permutation(len(order)):
            times[order[place]].append(seconds_of(runs[order[place]]))
    return {
        name: {
            "steps_per_second": steps / float(np.median(taken)),
            **_speed_ratio(np.divide(times[standard(name)], taken)),
        }
        for name, taken in times.items()
    }


def _speed_ratio(ratios: np.ndarray) -> dict[str, Any]:
    drawn = np.random.default_rng(0).choice(ratios, (2000, len(ratios)))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return {
        "ratio": float(np.median(ratios)),
        "interval": [float(low), float(high)],
        "runs": len(ratios),
    }


def random_actions(num_steps: int, num_envs: int, action_size: int) -> np.ndarray:
    """Draw (T, N, A) float32 actions in [-1, 1]."""
    shape = (num_steps, num_envs, action_size)
    return np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)


def compare(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Measure steps per second of each installed adapter and of the JAX environment.

    All get the same actions and play the same episodes. ``ratio`` is the speed relative to a
    Python loop over the compiled step that has the same autoreset mode and waits for each step.
    """
    return compare_runs(*adapter_runs(task, num_envs), seconds)


def adapter_runs(task: str, num_envs: int) -> tuple[dict[tuple[str, str], Run], int]:
    """Return runs by adapter and autoreset mode, and the steps of each; first calls compile."""
    env, params = pb.make(task)
    actions = random_actions(max(8, min(100, 512 // num_envs)), num_envs, env.action_size)
    runs: dict[tuple[str, str], Run] = {
        ("JAX scan", "next_step"): scan(task, num_envs, actions),
        ("JAX loop", "next_step"): loop(env, params, num_envs, actions),
    }
    for output in ("jax", "torch", "numpy") if find_spec("torch") else ("jax", "numpy"):
        runs[f"Gymnasium, {output}", "next_step"] = _gymnasium(task, num_envs, output, actions)
    others = {"torchrl": ("TorchRL", _torchrl), "stable_baselines3": ("Stable-Baselines3", _sb3)}
    installed = [row for package, row in others.items() if find_spec(package)]
    if installed:
        runs["JAX loop", "same_step"] = loop(env, params, num_envs, actions, "same_step")
    for name, make in installed:
        runs[name, "same_step"] = make(task, num_envs, actions)
    return runs, num_envs * len(actions)


def compare_runs(
    runs: Mapping[tuple[str, str], Run], steps: int, seconds: float
) -> list[dict[str, Any]]:
    """Measure the runs of ``adapter_runs``; see ``compare``."""
    found = compare_speeds(runs, steps, lambda name: ("JAX loop", name[1]), seconds)
    return [
        {"adapter": name, "autoreset_mode": mode, **speed} for (name, mode), speed in found.items()
    ]


def scan(task: str, num_envs: int, actions: np.ndarray) -> Run:
    """Return one compiled loop over the (T, num_envs, A) float32 actions."""
    env, params = pb.make(task)
    venv = pb.VectorPixelEnv(env, num_envs)

    def steps(state: Any, actions: jax.Array, params: Any) -> Any:
        def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            state, timestep = venv.step(state, action, params)
            return state, timestep.reward

        return jax.lax.scan(step, state, actions)

    program = jax.jit(steps, donate_argnums=0, compiler_options=pb.compiler_options(venv))
    carry = {"state": venv.reset(_keys(num_envs), params)[0]}
    params, own = jax.device_put((params, actions))

    def run() -> Any:
        carry["state"], rewards = program(carry["state"], own, params)
        return jax.block_until_ready(rewards)

    return run


def loop(env: Any, params: Any, num_envs: int, actions: np.ndarray, mode: str = "next_step") -> Run:
    """Return a Python loop over the compiled step that waits for each step."""
    venv = pb.VectorPixelEnv(env, num_envs, mode)
    step = jax.jit(venv.step, donate_argnums=0, compiler_options=pb.compiler_options(venv))
    params = jax.device_put(params)
    carry = {"state": venv.reset(_keys(num_envs), params)[0]}
    own = list(map(jax.device_put, actions))

    def run() -> Any:
        for action in own:
            carry["state"], timestep = step(carry["state"], action, params)
            jax.block_until_ready(timestep)
        return timestep

    return run


def _keys(num_envs: int) -> jax.Array:
    return jax.vmap(jax.random.key)(jnp.arange(num_envs))


def _gymnasium(task: str, num_envs: int, output: str, actions: np.ndarray) -> Run:
    envs = gymnasium.make_vec(TASKS[task].gymnasium_id, num_envs=num_envs, output=output)
    first, _ = envs.reset(seed=0)
    own, wait = list(actions), lambda obs: obs
    if output == "jax":
        own, wait = list(map(jax.device_put, actions)), jax.block_until_ready
    elif output == "torch":
        own, wait = _tensors(actions, first.device), _wait_for_torch

    def run() -> Any:
        for action in own:
            obs = wait(envs.step(action)[0])
        return obs

    return run


def _torchrl(task: str, num_envs: int, actions: np.ndarray) -> Run:
    env = pixelbrax_gym.TorchRLEnv(task, num_envs)
    env.set_seed(0)
    carry = {"td": env.reset()}
    own = _tensors(actions, env.device)

    def run() -> None:
        for action in own:
            _, carry["td"] = env.step_and_maybe_reset(carry["td"].set("action", action))
            _wait_for_torch()

    return run


def _sb3(task: str, num_envs: int, actions: np.ndarray) -> Run:
    env = pixelbrax_gym.SB3VecEnv(task, num_envs)
    env.seed(0)
    env.reset()

    def run() -> None:
        for action in actions:
            env.step(action)

    return run


def _tensors(actions: np.ndarray, device: Any) -> list[Any]:
    """Return one tensor per step, on the environments' device."""
    import torch

    return [torch.from_numpy(action).to(device) for action in actions]


def _wait_for_torch(obs: Any = None) -> Any:
    """Return ``obs`` when CUDA is idle; tensors on a CPU are always complete."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return obs
