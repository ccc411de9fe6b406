"""Compare the adapters to Gymnasium, TorchRL and Stable-Baselines3 in interleaved runs."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import pixelbrax_gym
import pixelbrax_jax as pb
from pixelbrax_gym.bench.timing import SECONDS, speed_ratio, take_interleaved
from pixelbrax_jax.tasks import TASKS

Run = Callable[[], Any]
"""Takes some steps and waits for their results."""


def compare(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Measure steps per second of each installed adapter and of the JAX environment.

    All get the same actions and play the same episodes. ``ratio`` is the speed relative to a
    Python loop over the compiled step that has the same autoreset mode and waits for each step.
    """
    env, params = pb.make(task)
    shape = (max(8, min(100, 512 // num_envs)), num_envs, env.action_size)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    runs: dict[tuple[str, str], Run] = {
        ("JAX scan", "next_step"): scan(task, num_envs, actions),
        ("JAX loop", "next_step"): loop(env, params, num_envs, actions),
    }
    for output in ("jax", "torch", "numpy") if find_spec("torch") else ("jax", "numpy"):
        runs[f"Gymnasium, {output}", "next_step"] = _gymnasium(task, num_envs, output, actions)
    others = {"torchrl": ("TorchRL", _torchrl), "stable_baselines3": ("Stable-Baselines3", _sb3)}
    found = [row for package, row in others.items() if find_spec(package)]
    if found:
        runs["JAX loop", "same_step"] = loop(env, params, num_envs, actions, "same_step")
    for name, make in found:
        runs[name, "same_step"] = make(task, num_envs, actions)
    times = take_interleaved(runs, seconds)
    return [
        {
            "adapter": name,
            "autoreset_mode": mode,
            "steps_per_second": num_envs * len(actions) / float(np.median(taken)),
            **speed_ratio(taken, times["JAX loop", mode]),
        }
        for (name, mode), taken in times.items()
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
    own = [jax.device_put(action) for action in actions]

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
        own, wait = [jax.device_put(action) for action in actions], jax.block_until_ready
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
