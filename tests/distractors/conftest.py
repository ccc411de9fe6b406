"""Small clips for a small task."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.distractors import ClipBank
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.types import Clips
from tests.envs.toy import PARAMS, Ball

SIZE = {"height": 24, "width": 20, "frame_stack": 2}


def make_bank(lengths=(5, 1, 8), height=24, width=20):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (sum(lengths), height, width, 3), dtype=np.uint8)
    names = tuple(f"clip{i}" for i in range(len(lengths)))
    return ClipBank(frames, np.array(lengths, np.int32), names, "tests", "train")


def make_clips(**options) -> Clips:
    return jax.tree.map(np.asarray, make_bank(**options).to_device())


def episode(distractor, num_frames, key=0, clips=None):
    """Timestep, clean or changed image, and state of each frame of an episode of the toy."""
    env = PixelEnv(Ball(), **SIZE, distractors=(distractor,) if distractor else ())
    params = PARAMS.replace(clips=make_clips() if clips is None else clips)
    state, timestep = env.reset(jax.random.key(key), params)
    yield timestep, env.render(state, params), state
    for _ in range(num_frames - 1):
        state, timestep = env.step(state, jnp.array([0.3]), params)
        yield timestep, env.render(state, params), state


def walk(distractor, params, steps, num):
    """States after the first frame of episodes of ``steps`` frames, (steps - 1, num, ...)."""

    def one(key):
        def step(state, t):
            state = distractor.advance(state, jax.random.fold_in(key, t), t, params)
            return state, state

        first = distractor.reset(jax.random.fold_in(key, 0), params)
        return jax.lax.scan(step, first, jnp.arange(1, steps))[1]

    keys = jax.vmap(jax.random.key)(jnp.arange(num))
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one, out_axes=1))(keys))
