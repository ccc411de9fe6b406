"""What distractors cost, interleaved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import pixelbrax_jax as pb
from pixelbrax_gym.bench.timing import SECONDS, speed_ratio, take_interleaved


def chains() -> dict[str, tuple[Any, ...]]:
    """Distractors by the name of their row."""
    kinds = pb.distractors
    background = kinds.Video(ground_alpha=0.3)
    return {
        "none": (),
        "none, a second time": (),
        "color, each frame": (kinds.Color(),),
        "color, each material": (kinds.Color("geom", "walk", 0.2, "uniform"),),
        "video overlay": (kinds.Video(mode="overlay"),),
        "video background": (background,),
        "camera": (kinds.Camera(scale=0.2),),
        "all three": (kinds.Color(), background, kinds.Camera(scale=0.2)),
    }


def noise_clips(size: int = 84) -> Any:
    """As many frames as DAVIS-2017's training split has at most: 60 clips of 70."""
    frames = np.random.default_rng(0).integers(0, 256, (60 * 70, size, size, 3), dtype=np.uint8)
    length = np.full(60, 70, np.int32)
    return pb.distractors.ClipBank(frames, length, tuple(map(str, range(60))), "noise", "train")


def compare(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Steps per second with and without distractors.

    The environment without any takes part twice: what lies between the two is not the cost of
    a distractor.

    Args:
        task: the task.
        num_envs: environments of each.
        seconds: about how long all take altogether, compilation apart.

    Returns:
        One entry for each; ``ratio`` is to the first.
    """
    calls = max(1, min(100, 512 // num_envs))
    clips = noise_clips()
    runners = {}
    for name, links in chains().items():
        plays = any(isinstance(link, pb.distractors.Video) for link in links)
        env, params = pb.make(task, distractors=links, clips=clips if plays else None)
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
    step = jax.jit(venv.step, donate_argnums=0, compiler_options=pb.compiler_options(venv))
    shape = (calls, num_envs, env.action_size)
    actions = list(jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0))
    carry = {"state": venv.reset(jax.random.key(0), params)[0]}

    def run() -> Any:
        for action in actions:
            carry["state"], timestep = step(carry["state"], action, params)
        return jax.block_until_ready(timestep)

    return run
