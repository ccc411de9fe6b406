"""The animated image of the front page: tasks and distractors, side by side.

    python examples/render_wall.py --output docs/images/wall.gif
    python examples/render_wall.py --output runs/wall.gif --num-frames 8 --only ant reacher

Tasks for which a policy comes with the package are played by it, the others by random actions.
Under distractors the policy sees the clean observation, for it was trained on that.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from PIL import Image

import pixelbrax_jax as pb
from pixelbrax_jax.distractors import Video
from pixelbrax_jax.distractors.presets import resolve

SIZE = 120  # pixels of a tile
GAP = 4
COLUMNS = 5
COLORS = 128  # one palette for all frames: small files that do not flicker
FPS = 20
WARM_UP = 20  # frames before the first that is shown: by then agents are under way

TILES: tuple[tuple[str, str | None], ...] = (
    ("halfcheetah", None),
    ("ant", None),
    ("humanoid", None),
    ("walker2d", None),
    ("hopper", None),
    ("reacher", None),
    ("halfcheetah", "dcs-medium"),
    ("ant", "video-hard"),
    ("humanoid", "paper-color"),
    ("walker2d", "paper-video"),
)
"""Task and distractors of each tile, row by row."""


def episode(task: str, num_frames: int) -> Any:
    """States of an episode, one after the other, (T, ...)."""
    policy = pb.load_policy(task) if task in pb.list_pretrained() else None
    random = {"task": task, "obs_mode": "state"}
    env, params = pb.make(**((policy and policy.env_options) or random))

    def step(carry, key):
        state, obs = carry
        if policy:
            action = policy.program(obs[None])[0]
        else:
            action = jax.random.uniform(key, (env.action_size,), minval=-1.0)
        state, timestep = env.step(state, action, params)
        return (state, timestep.obs), state

    def run(key):
        state, timestep = env.reset(key, params)
        keys = jax.random.split(key, WARM_UP + num_frames)
        return jax.lax.scan(step, (state, timestep.obs), keys)[1]

    states = jax.jit(run)(jax.random.key(0))
    return jax.tree.map(lambda x: x[WARM_UP:], states)


def tile(task: str, distractors: str | None, states: Any, seed: int) -> np.ndarray:
    """One tile's frames, (T, SIZE, SIZE, 3) uint8."""
    links = resolve((distractors,) if distractors else (), task)
    plays = any(isinstance(link, Video) for link in links)
    env, params = pb.make(
        task,
        height=SIZE,
        width=SIZE,
        look=pb.make_look("default", shadows=True),
        distractors=links,
        clips="procedural" if plays else None,
    )
    chain, key = env.chain, jax.random.key(seed)

    def step(distractor_state, state):
        later = chain.advance(distractor_state, key, state.sim.step_count + 1, params)
        shown = state.replace(sim=state.sim.replace(distractor_state=distractor_state))
        return later, env.image(shown, params)

    return np.asarray(jax.jit(lambda s: jax.lax.scan(step, chain.reset(key, params), s)[1])(states))


def wall(tiles: Sequence[np.ndarray]) -> np.ndarray:
    """Tiles in rows, (T, H, W, 3) uint8."""
    columns = min(COLUMNS, len(tiles))
    padded = [np.pad(t, ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255) for t in tiles]
    padded += [np.full_like(padded[0], 255)] * (-len(padded) % columns)
    rows = [np.concatenate(padded[k : k + columns], axis=2) for k in range(0, len(padded), columns)]
    return np.concatenate(rows, axis=1)[:, :-GAP, :-GAP]


def save(frames: np.ndarray, path: str) -> None:
    """Write a GIF whose frames have one palette."""
    sample = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 6)]))
    palette = sample.quantize(COLORS)
    images = [
        Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames
    ]
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 // FPS, loop=0)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", default="docs/images/wall.gif")
    parser.add_argument("--num-frames", type=int, default=60)
    parser.add_argument("--only", nargs="+", default=pb.list_envs(), help="tiles of these tasks")
    options = parser.parse_args(arguments)
    chosen = [(task, behind) for task, behind in TILES if task in options.only]
    states = {task: episode(task, options.num_frames) for task in {task for task, _ in chosen}}
    tiles = [tile(*which, states[which[0]], seed) for seed, which in enumerate(chosen)]
    save(wall(tiles), options.output)


if __name__ == "__main__":
    main()
