"""What distractors cost, interleaved."""

from __future__ import annotations

from typing import Any

import numpy as np

import pixelbrax_jax as pb
from pixelbrax_gym.bench.adapters import SECONDS, compare_speeds, loop, random_actions


def chains() -> dict[str, tuple[Any, ...]]:
    """Return distractors by the name of their row."""
    kinds = pb.distractors
    background = kinds.Video(ground_alpha=0.3)
    return {
        "none": (),
        "none, a second time": (),
        "color, each frame": (kinds.Color(),),
        "color, each material": (kinds.Color("geom", "walk", 0.2, "uniform"),),
        "video overlay": (kinds.Video(mode="overlay"),),
        "video background": (background,),
        "camera": (kinds.MovingCamera(scale=0.2),),
        "all three": (kinds.Color(), background, kinds.MovingCamera(scale=0.2)),
    }


def noise_clips(size: int = 84) -> Any:
    """Return as many frames as DAVIS-2017's training split has at most: 60 clips of 70."""
    frames = np.random.default_rng(0).integers(0, 256, (60 * 70, size, size, 3), dtype=np.uint8)
    length = np.full(60, 70, np.int32)
    return pb.distractors.ClipBank(frames, length, tuple(map(str, range(60))), "noise", "train")


def compare(task: str, num_envs: int, seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Measure steps per second with and without distractors.

    The environment without any takes part twice: what lies between the two is not the cost of
    a distractor.
    """
    clips, runs = noise_clips(), {}
    for name, links in chains().items():
        plays = any(isinstance(link, pb.distractors.Video) for link in links)
        env, params = pb.make(task, distractors=links, clips=clips if plays else None)
        actions = random_actions(max(1, min(100, 512 // num_envs)), num_envs, env.action_size)
        runs[name] = loop(env, params, num_envs, actions)
    found = compare_speeds(runs, num_envs * len(actions), lambda _: "none", seconds)
    return [{"distractors": name, **speed} for name, speed in found.items()]
