"""What Gymnasium's wrappers change, where they do the same for one environment and for many."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import cv2
import numpy as np

PICTURES = {"render_mode": "rgb_array", "render_height": 32, "render_width": 32}
UNSEEN = {"obs_mode": "state"}


def same(x: Any) -> Any:
    """What a wrapper leaves alone."""
    return x


class Change(NamedTuple):
    """A wrapper, and what it changes of a single environment's results.

    ``wrap`` takes the module of wrappers, of one environment or of many, and the environment.
    """

    wrap: Callable[[ModuleType, Any], Any]
    obs: Callable[[Any], Any] = same
    reward: Callable[[Any], Any] = same
    action: Callable[[Any], Any] = same
    obs_mode: str = "pixels"


def takes_actions_of_any_size(wrappers: ModuleType, env: Any) -> Any:
    clipped = wrappers.ClipAction(env)
    assert np.isinf(clipped.action_space.high).all()
    return wrappers.TransformAction(clipped, lambda action: 7 * action, None)


def takes_percent(wrappers: ModuleType, env: Any) -> Any:
    percent = wrappers.RescaleAction(env, np.float32(0), np.float32(100))
    assert (percent.action_space.high == 100).all()
    return wrappers.TransformAction(percent, lambda action: 50 * action + 50, None)


def darken(pixels: np.ndarray) -> np.ndarray:
    """Half of the brightness, in place."""
    pixels //= 2
    return pixels


CHANGES = {
    "ClipAction": Change(takes_actions_of_any_size, action=lambda action: 7 * action),
    "ClipReward": Change(
        lambda wrappers, env: wrappers.ClipReward(env, -0.5, -0.4),
        reward=lambda reward: np.clip(reward, -0.5, -0.4),
    ),
    "DtypeObservation": Change(
        lambda wrappers, env: wrappers.DtypeObservation(env, np.float32), obs=np.float32
    ),
    "FilterObservation": Change(
        lambda wrappers, env: wrappers.FilterObservation(env, ["state"]),
        obs=lambda both: {"state": both["state"]},
        obs_mode="both",
    ),
    "FlattenObservation": Change(
        lambda wrappers, env: wrappers.FlattenObservation(env),
        obs=lambda both: np.concatenate([both["pixels"].ravel(), both["state"]]),
        obs_mode="both",
    ),
    "GrayscaleObservation": Change(
        lambda wrappers, env: wrappers.GrayscaleObservation(env),
        obs=lambda pixels: np.uint8((pixels * [0.2125, 0.7154, 0.0721]).sum(axis=-1)),
    ),
    "RescaleAction": Change(takes_percent),
    "RescaleObservation": Change(
        lambda wrappers, env: wrappers.RescaleObservation(
            wrappers.DtypeObservation(env, np.float32), np.float32(-1), np.float32(1)
        ),
        obs=lambda pixels: np.float32(pixels / 127.5 - 1),
    ),
    "ReshapeObservation": Change(
        lambda wrappers, env: wrappers.ReshapeObservation(env, (12, 36)),
        obs=lambda pixels: pixels.reshape(12, 36),
    ),
    "ResizeObservation": Change(
        lambda wrappers, env: wrappers.ResizeObservation(env, (6, 6)),
        obs=lambda pixels: cv2.resize(pixels, (6, 6), interpolation=cv2.INTER_AREA),
    ),
    "TransformAction": Change(
        lambda wrappers, env: wrappers.TransformAction(env, lambda action: -action, None),
        action=lambda action: -action,
    ),
    # It may write to what it gets.
    "TransformObservation": Change(
        lambda wrappers, env: wrappers.TransformObservation(env, darken, None),
        obs=lambda pixels: pixels // 2,
    ),
    "TransformReward": Change(
        lambda wrappers, env: wrappers.TransformReward(env, lambda reward: 2 * reward + 1),
        reward=lambda reward: 2 * reward + 1,
    ),
}


def cases() -> tuple[dict[str, Callable], Callable]:
    """Tests by the wrapper they are about, and a decorator that files one."""
    filed: dict[str, Callable] = {}

    def case(name: str) -> Callable[[Callable], Callable]:
        assert name not in filed
        return lambda test: filed.setdefault(name, test)

    return filed, case


def moments(seen: np.ndarray) -> tuple[Any, Any]:
    """Mean and variance of what was seen, beside Gymnasium's 0.0001 imagined draws of N(0, 1)."""
    count = len(seen) + 1e-4
    mean = seen.sum(axis=0) / count
    return mean, (1e-4 + (seen**2).sum(axis=0)) / count - mean**2
