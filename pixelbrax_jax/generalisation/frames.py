"""Contact sheets of levels: the first frame of each."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from pixelbrax_jax.compilation import jit
from pixelbrax_jax.distractors.contact_sheet import labelled
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.generalisation.making import Levels
from pixelbrax_jax.generalisation.suites import EPISODES
from pixelbrax_jax.types import EnvParams

_SMALLEST = 168
"""Least height of a frame in pixels; smaller images are rendered larger by a whole factor."""


def write_sheet(levels: Levels, path: str | Path) -> None:
    """Write an image with the first frame of each level; raise an ImportError without Pillow."""
    with default_flags():
        key = VectorPixelEnv.env_keys(jax.random.key(EPISODES), 1)[0]
    frames = {}
    for one in levels.levels:
        factor = max(1, -(-_SMALLEST // one.env.height))
        size = factor * one.env.height, factor * one.env.width
        params = levels.params_of(one, 0)
        frames[one.level.name] = np.asarray(_first_frame(one.env, key, params, *size))
    labelled(frames).save(path)


@jit(static_argnums=(0, 3, 4))
def _first_frame(
    env: PixelEnv, key: jax.Array, params: EnvParams, height: int, width: int
) -> jax.Array:
    state, _ = env.reset(key, params)
    return env.image(state, params, height, width)
