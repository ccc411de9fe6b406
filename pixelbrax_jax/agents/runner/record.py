"""Write a video of a trained agent."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.agents.runner.splits import SPLITS, make_split
from pixelbrax_jax.agents.runner.trained import Trained, with_clips
from pixelbrax_jax.compilation import compiler_options
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.validation import check_choice, check_positive_int
from pixelbrax_jax.video import write_frames


def write_video(
    agent: Trained,
    path: str | Path,
    *,
    split: str = "clean",
    clips: str | None = None,
    grid: int = 3,
    size: int = 168,
    num_frames: int = 300,
    seed: int = 0,
) -> Path:
    """Write a video of ``grid`` x ``grid`` episodes with mean actions, and return its path.

    The suffix of ``path`` selects MP4 or animated GIF. ``split`` is ``"clean"``, ``"train"`` or
    ``"test"``. ``clips`` is a folder; None uses the training's. ``size`` is height and width of one
    episode in pixels.

    Raises:
        NoSplitError: the clips do not match the split.
        ValueError: an option is out of range, or the run has no such split.
        FileNotFoundError: the folder of the clips is missing.
        ImportError: imageio-ffmpeg or Pillow is not installed.
        OSError: the file cannot be written, or does not show the rendered frames.
    """
    check_positive_int("grid", grid)
    check_positive_int("size", size)
    check_positive_int("num_frames", num_frames)
    check_choice("split", split, SPLITS)
    algorithm, networks = agent.algorithm, agent.networks
    config, shown = with_clips(agent, clips)
    env, params = make_split(config, split, shown)
    envs = VectorPixelEnv(env, grid * grid)

    @partial(jax.jit, compiler_options=compiler_options(env))
    def step(state: Any, params: Any) -> tuple[Any, jax.Array]:
        action = algorithm.act(networks, envs.obs(state))
        state, _ = envs.step(state, action, params)
        draw = jax.vmap(lambda state: env.image(state, params, size, size))
        return state, draw(state)

    def frames() -> Iterator[np.ndarray]:
        with default_flags():
            key = jax.random.key(seed)
        state, _ = envs.reset(key, params)
        for _ in range(num_frames):
            state, images = step(state, params)
            tiles = jax.device_get(images).reshape(grid, grid, size, size, 3)
            yield np.concatenate(np.concatenate(tiles, axis=1), axis=1)

    fps = min(max(1, round(1.0 / env.dt)), 60)
    return write_frames(path, frames(), fps)
