"""Comparisons within one process, interleaved.

A change of the machine's mood then strikes everyone alike, so that ratios hold where speeds do
not. Turns are short and their order is drawn anew in each round; a ratio is the median over the
rounds, and its interval tells how far the machine can be trusted.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import torch

import pixelbrax_gym
import pixelbrax_jax as pb
from pixelbrax_jax.distractors import Camera, ClipBank, Color, Video
from tests.benchmarks.cases import TASKS

SECONDS = 90.0
"""About how long the runs of a comparison take altogether."""


def take_interleaved(
    runners: Mapping[Hashable, Callable[[], Any]], seconds: float = SECONDS
) -> dict[Any, list[float]]:
    """Seconds of each runner's runs, one in each round: at least five rounds, at most 300."""
    for run in runners.values():
        run()
    order = list(runners)
    draw = np.random.default_rng(0)
    started = time.perf_counter()
    times: dict[Any, list[float]] = {key: [] for key in runners}
    rounds = 0
    while rounds < 5 or (rounds < 300 and time.perf_counter() - started < seconds):
        rounds += 1
        for place in draw.permutation(len(order)):
            key = order[place]
            began = time.perf_counter()
            runners[key]()
            times[key].append(time.perf_counter() - began)
    return times


def speed_ratio(seconds: list[float], standard: list[float]) -> dict[str, Any]:
    """How fast a runner is beside a standard, round by round.

    Returns:
        ``ratio``, the median over the rounds, more than 1 for the faster, and ``interval``, the
        bounds of its bootstrap interval of 95 %.
    """
    ratios = np.divide(standard, seconds)
    drawn = np.random.default_rng(0).choice(ratios, (2000, len(ratios)))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return {"ratio": float(np.median(ratios)), "interval": [float(low), float(high)]}


def batches(task: str, sizes: Sequence[int], seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second over the number of environments; ``ratio`` is to the first."""
    action_size = pb.make(task)[0].action_size
    # 16 steps of the largest number: a call takes fresh memory, a tenth of the time of four steps.
    steps = 16 * math.lcm(*sizes)
    runners = {}
    for num_envs in sizes:
        shape = (steps // num_envs, num_envs, action_size)
        actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
        runners[num_envs] = _jax_scan(task, num_envs, "next_step", actions)
    times = take_interleaved(runners, seconds)
    return [
        {
            "num_envs": num_envs,
            "steps_per_second": steps / float(np.median(runs)),
            **speed_ratio(runs, times[sizes[0]]),
            "runs": len(runs),
        }
        for num_envs, runs in times.items()
    ]


def adapters(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second of every adapter to PyTorch, and of the functional environment in Python.

    ``ratio`` is to the functional loop with the same autoreset mode that waits for each step as the
    adapter does. All see the same actions and the same episodes.
    """
    # So many that a loop that never waits can be told from one that does.
    calls = max(8, min(100, 512 // num_envs))
    action_size = pb.make(task)[0].action_size
    shape = (calls, num_envs, action_size)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    runners: dict[tuple[str, str], Callable[[], Any]] = {}
    for mode in ("next_step", "same_step"):
        runners["JAX scan", mode] = _jax_scan(task, num_envs, mode, actions)
        runners["JAX loop", mode] = _jax_loop(task, num_envs, mode, actions, waits=True)
        runners["JAX loop, never waiting", mode] = _jax_loop(
            task, num_envs, mode, actions, waits=False
        )
    for output in ("jax", "torch", "numpy"):
        runners[f"Gymnasium, {output}", "next_step"] = _gymnasium(task, num_envs, output, actions)
    runners["TorchRL, _step", "same_step"] = _torchrl(task, num_envs, actions, whole=False)
    runners["TorchRL, step_and_maybe_reset", "same_step"] = _torchrl(
        task, num_envs, actions, whole=True
    )
    runners["Stable-Baselines3", "same_step"] = _sb3(task, num_envs, actions)
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


def _jax_loop(
    task: str, num_envs: int, mode: str, actions: np.ndarray, *, waits: bool
) -> Callable[[], Any]:
    env, params = pb.make(task)
    params = jax.device_put(params)
    venv = pb.VectorPixelEnv(env, num_envs, mode)
    step = jax.jit(venv.step, donate_argnums=0, compiler_options=pb.compiler_options())
    keys = jax.vmap(jax.random.key)(jnp.arange(num_envs))
    carry = {"state": venv.reset(keys, params)[0]}
    own = [jax.device_put(action) for action in actions]

    def run() -> Any:
        for action in own:
            carry["state"], timestep = step(carry["state"], action, params)
            if waits:
                jax.block_until_ready(timestep)
        return jax.block_until_ready(timestep)

    return run


def _jax_scan(task: str, num_envs: int, mode: str, actions: np.ndarray) -> Callable[[], Any]:
    env, params = pb.make(task)
    venv = pb.VectorPixelEnv(env, num_envs, mode)

    def steps(state: Any, actions: jax.Array, params: Any) -> Any:
        def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            state, timestep = venv.step(state, action, params)
            return state, timestep.reward

        return jax.lax.scan(step, state, actions)

    program = jax.jit(steps, donate_argnums=0, compiler_options=pb.compiler_options())
    keys = jax.vmap(jax.random.key)(jnp.arange(num_envs))
    carry = {"state": venv.reset(keys, params)[0]}
    params, own = jax.device_put((params, actions))

    def run() -> Any:
        carry["state"], rewards = program(carry["state"], own, params)
        return jax.block_until_ready(rewards)

    return run


def _gymnasium(task: str, num_envs: int, output: str, actions: np.ndarray) -> Callable[[], Any]:
    name = f"PixelBrax/{TASKS[task]}-v0"
    envs = gymnasium.make_vec(name, num_envs=num_envs, output=output)
    first, _ = envs.reset(seed=0)
    convert: dict[str, Callable[[np.ndarray], Any]] = {
        "jax": jax.device_put,
        "torch": lambda action: torch.from_numpy(action).to(first.device),
        "numpy": np.asarray,
    }
    own = [convert[output](action) for action in actions]

    def run() -> Any:
        for action in own:
            obs = envs.step(action)[0]
            if output == "jax":
                jax.block_until_ready(obs)
            elif output == "torch":
                _wait_for_torch()
        return obs

    return run


def _torchrl(task: str, num_envs: int, actions: np.ndarray, *, whole: bool) -> Callable[[], Any]:
    env = pixelbrax_gym.PixelBraxTorchRLEnv(task, num_envs)
    env.set_seed(0)
    carry = {"td": env.reset()}
    own = [torch.from_numpy(action).to(env.device) for action in actions]

    def run() -> Any:
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

    return run


def _sb3(task: str, num_envs: int, actions: np.ndarray) -> Callable[[], Any]:
    env = pixelbrax_gym.PixelBraxSB3VecEnv(task, num_envs)
    env.seed(0)
    env.reset()

    def run() -> Any:
        for action in actions:
            obs = env.step(action)[0]
        return obs

    return run


def _wait_for_torch() -> None:
    """On a CPU a tensor is complete when it is handed out."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


CHAINS = {
    "none": (),
    "none, a second time": (),
    "color, each frame": (Color(),),
    "color, each material": (Color("geom", "walk", 0.2, "uniform"),),
    "video overlay": (Video(mode="overlay"),),
    "video background": (Video(ground_alpha=0.3),),
    "camera": (Camera(scale=0.2),),
    "all three": (Color(), Video(ground_alpha=0.3), Camera(scale=0.2)),
}


def synthetic_bank(size: int = 84) -> ClipBank:
    """As many frames as DAVIS-2017's training split has at most: 60 clips of 70."""
    frames = np.random.default_rng(0).integers(0, 256, (60 * 70, size, size, 3), dtype=np.uint8)
    length = np.full(60, 70, np.int32)
    return ClipBank(frames, length, tuple(map(str, range(60))), "noise", "train")


def distractors(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second with and without distractors.

    The environment without any takes part twice: what lies between the two is not the cost of
    a distractor.
    """
    calls = max(1, min(100, 512 // num_envs))
    bank = synthetic_bank()
    runners = {}
    for name, links in CHAINS.items():
        plays = any(isinstance(link, Video) for link in links)
        env, params = pb.make(task, distractors=links, clips=bank if plays else None)
        runners[name] = _stepper(env, jax.device_put(params), num_envs, calls)
    times = take_interleaved(runners, seconds)
    clean = times["none"]
    return [
        {
            "distractors": name,
            "steps_per_second": num_envs * calls / float(np.median(runs)),
            **speed_ratio(runs, clean),
            "runs": len(runs),
        }
        for name, runs in times.items()
    ]


def _stepper(env: Any, params: Any, num_envs: int, calls: int) -> Callable[[], Any]:
    venv = pb.VectorPixelEnv(env, num_envs)
    step = jax.jit(venv.step, donate_argnums=0, compiler_options=pb.compiler_options())
    shape = (calls, num_envs, env.action_size)
    actions = list(jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0))
    carry = {"state": venv.reset(jax.random.key(0), params)[0]}

    def run() -> Any:
        for action in actions:
            carry["state"], timestep = step(carry["state"], action, params)
        return jax.block_until_ready(timestep)

    return run
