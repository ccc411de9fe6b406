"""What an adapter to Gymnasium, TorchRL or Stable-Baselines3 costs, interleaved."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
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


def compare(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second of every adapter that is installed, and of the functional environment.

    All see the same actions and the same episodes.

    Args:
        task: the task.
        num_envs: environments of each.
        seconds: about how long all take altogether, compilation apart.

    Returns:
        One entry for each; ``ratio`` is to a Python loop over the compiled step with the same
        autoreset mode that waits for each step, as an adapter does.
    """
    # So many that a loop that never waits can be told from one that does.
    calls = max(8, min(100, 512 // num_envs))
    action_size = pb.make(task)[0].action_size
    shape = (calls, num_envs, action_size)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    has_torch = find_spec("torch") is not None
    runners: dict[tuple[str, str], Callable[[], Any]] = {}
    runners["JAX scan", "next_step"] = scan(task, num_envs, actions)
    runners.update(_jax_loops(task, num_envs, "next_step", actions))
    for output in ("jax", "torch", "numpy") if has_torch else ("jax", "numpy"):
        runners[f"Gymnasium, {output}", "next_step"] = _gymnasium(task, num_envs, output, actions)
    others = {"torchrl": ("TorchRL", _torchrl), "stable_baselines3": ("Stable-Baselines3", _sb3)}
    found = {package: row for package, row in others.items() if find_spec(package)}
    if found:
        runners.update(_jax_loops(task, num_envs, "same_step", actions))
    for name, make in found.values():
        runners[name, "same_step"] = make(task, num_envs, actions)
    times = take_interleaved(runners, seconds)
    return [
        {
            "adapter": name,
            "autoreset_mode": mode,
            "steps_per_second": num_envs * calls / float(np.median(runs)),
            **speed_ratio(runs, times["JAX loop", mode]),
            "runs": len(runs),
        }
        for (name, mode), runs in times.items()
    ]


def scan(task: str, num_envs: int, actions: np.ndarray) -> Callable[[], Any]:
    """A runner: one compiled loop over the (T, num_envs, A) float32 actions."""
    env, params = pb.make(task)
    venv = pb.VectorPixelEnv(env, num_envs)

    def steps(state: Any, actions: jax.Array, params: Any) -> Any:
        def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            state, timestep = venv.step(state, action, params)
            return state, timestep.reward

        return jax.lax.scan(step, state, actions)

    program = jax.jit(steps, donate_argnums=0, compiler_options=pb.compiler_options(venv))
    keys = jax.vmap(jax.random.key)(jnp.arange(num_envs))
    carry = {"state": venv.reset(keys, params)[0]}
    params, own = jax.device_put((params, actions))

    def run() -> Any:
        carry["state"], rewards = program(carry["state"], own, params)
        return jax.block_until_ready(rewards)

    return run


def _jax_loops(
    task: str, num_envs: int, mode: str, actions: np.ndarray
) -> dict[tuple[str, str], Callable[[], Any]]:
    """A Python loop over the compiled step, which waits for each step or for the last alone."""
    env, params = pb.make(task)
    params = jax.device_put(params)
    venv = pb.VectorPixelEnv(env, num_envs, mode)
    step = jax.jit(venv.step, donate_argnums=0, compiler_options=pb.compiler_options(venv))
    keys = jax.vmap(jax.random.key)(jnp.arange(num_envs))
    carry = {"state": venv.reset(keys, params)[0]}
    own = [jax.device_put(action) for action in actions]

    def run(waits: bool) -> Any:
        for action in own:
            carry["state"], timestep = step(carry["state"], action, params)
            if waits:
                jax.block_until_ready(timestep)
        return jax.block_until_ready(timestep)

    names = {"JAX loop": True, "JAX loop, never waiting": False}
    return {(name, mode): partial(run, waits) for name, waits in names.items()}


def _gymnasium(task: str, num_envs: int, output: str, actions: np.ndarray) -> Callable[[], Any]:
    envs = gymnasium.make_vec(TASKS[task].gymnasium_id, num_envs=num_envs, output=output)
    first, _ = envs.reset(seed=0)
    own = list(actions)
    if output == "jax":
        own = [jax.device_put(action) for action in actions]
    elif output == "torch":
        own = _tensors(actions, first.device)

    def run() -> Any:
        for action in own:
            obs = envs.step(action)[0]
            if output == "jax":
                jax.block_until_ready(obs)
            elif output == "torch":
                _wait_for_torch()
        return obs

    return run


def _torchrl(task: str, num_envs: int, actions: np.ndarray) -> Callable[[], Any]:
    env = pixelbrax_gym.TorchRLEnv(task, num_envs)
    env.set_seed(0)
    carry = {"td": env.reset()}
    own = _tensors(actions, env.device)

    def run() -> Any:
        for action in own:
            _, carry["td"] = env.step_and_maybe_reset(carry["td"].set("action", action))
            _wait_for_torch()
        return carry["td"]

    return run


def _sb3(task: str, num_envs: int, actions: np.ndarray) -> Callable[[], Any]:
    env = pixelbrax_gym.SB3VecEnv(task, num_envs)
    env.seed(0)
    env.reset()

    def run() -> Any:
        for action in actions:
            obs = env.step(action)[0]
        return obs

    return run


def _tensors(actions: np.ndarray, device: Any) -> list[Any]:
    """One tensor a step, where the environments are."""
    import torch

    return [torch.from_numpy(action).to(device) for action in actions]


def _wait_for_torch() -> None:
    """On a CPU a tensor is complete when it is handed out."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()
