"""The ball of the other tests under a Gymnasium id of its own, also for processes of clients.

Gymnasium imports this module when it makes ``ID``: workers that were spawned know nothing else.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import cv2
import gymnasium
import numpy as np

import pixelbrax_gym
import pixelbrax_jax
from tests.envs.toy import PARAMS, Ball

TASK = "clients_ball"
if TASK not in pixelbrax_jax.list_envs():
    pixelbrax_jax.register(TASK, Ball, camera=PARAMS.rig)
    pixelbrax_gym.register(TASK, "PixelBrax/ClientsBall-v0")
ID = f"{__name__}:PixelBrax/ClientsBall-v0"

LIMIT = 6
"""Steps of an episode."""

SIZE = {"height": 12, "width": 12, "frame_stack": 1, "episode_length": LIMIT}

# The ball is seen to move either way and does not leave the line.
ACTIONS = np.array([0.5, -1.0, 0.25, 1.0, -0.5, 0.75, -0.25, 0.5, 0.5], np.float32)[:, None]


@dataclass
class Steps:
    """A reset and the steps after it; copies, as wrappers may write to what they get."""

    obs: list[Any]
    rewards: list[Any]
    terminated: list[Any]
    truncated: list[Any]
    infos: list[Any]


def make(**options: Any) -> gymnasium.Env:
    """One ball, as Gymnasium makes it."""
    return gymnasium.make(ID, **(SIZE | options))


def make_vec(num_envs: int = 3, **options: Any) -> gymnasium.vector.VectorEnv:
    """Several balls, as Gymnasium makes them."""
    return gymnasium.make_vec(ID, num_envs=num_envs, **(SIZE | options))


def assert_same_images(actual: Any, expected: Any) -> None:
    """Check images of programs for other numbers of environments, which round a few otherwise."""
    difference = np.abs(np.int32(actual) - np.int32(expected))
    assert difference.max() <= 1
    assert np.mean(difference > 0) < 0.01


def play(env: Any, actions: Any, seed: int = 0) -> Steps:
    """What an environment answers; closes it."""
    obs, info = env.reset(seed=seed)
    steps = Steps([copy.deepcopy(obs)], [], [], [], [copy.deepcopy(info)])
    for action in actions:
        answer = copy.deepcopy(env.step(action))
        for kept, value in zip(vars(steps).values(), answer, strict=True):
            kept.append(value)
    env.close()
    return steps


def frames_of(video: str) -> np.ndarray:
    """The (T, height, width, 3) uint8 frames of a film."""
    film, frames = cv2.VideoCapture(video), []
    while (read := film.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return np.array(frames)
