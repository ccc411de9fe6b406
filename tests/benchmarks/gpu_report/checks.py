"""What the device is, and whether the kernel draws what the plain ray-caster does."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import jax
import numpy as np

import pixelbrax_jax as pb
from pixelbrax_gym.bench import machine, throughput
from pixelbrax_jax.renderer import choice

NUM_POSES = 5


def identity() -> Callable[[float], dict[str, Any]]:
    """Describe the device and the renderer that ``"auto"`` means there, and why.

    ``kernel`` is whether the device can run the kernel, be it right or not.
    """
    found = {**machine.describe(), "memory": jax.devices()[0].memory_stats()}
    renderer, why = choice.auto_renderer()
    can = choice.why_not_here() is None
    return lambda _: found | {"renderer": renderer, "why": why, "kernel": can}


def kernel(task: str, size: int) -> Callable[[float], list[dict[str, Any]]]:
    """Compare images of the kernel and of the plain ray-caster, without and with shadows.

    Each has ``same``, the fraction of pixels that are at most a level of 255 apart, and ``apart``,
    the largest difference in levels.
    """
    found = []
    with _on_any_device():
        for shadows in (False, True):
            images = [_images(task, size, shadows, renderer) for renderer in ("pallas", "fused")]
            apart = np.abs(images[0] - images[1]).max(-1)
            found.append(
                {
                    "shadows": shadows,
                    "same": float(np.mean(apart <= 1)),
                    "apart": int(apart.max()),
                    "contrast": float(images[1].std()),
                }
            )
    return lambda _: found


def _on_any_device() -> Any:
    """Return a context in which XLA computes the kernel, except on a GPU."""
    if jax.default_backend() == "gpu":
        return nullcontext()
    from tests.renderer.interpreted import interpreted_kernel

    return interpreted_kernel()


def _images(task: str, size: int, shadows: bool, renderer: str) -> np.ndarray:
    """Return (N, H, W, 4) int images of the first states of episodes."""
    env, params = pb.make(task, renderer=renderer, shadows=shadows, height=size, width=size)
    states = throughput.first_states(env, params, NUM_POSES)
    words = np.asarray(jax.jit(jax.vmap(env.draw, in_axes=(0, None)))(states, params))
    return words[..., None].view(np.uint8).astype(int)
