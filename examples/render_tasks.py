"""The documentation's images of tasks: a wall of them, one animation of each, looks and cameras.

    python examples/render_tasks.py --output-dir docs/images
    python examples/render_tasks.py --output-dir runs/images --num-frames 8 --only ant reacher
    python examples/render_tasks.py --output-dir docs/images --suite dmc

Tasks for which a policy comes with the package are played by it, the others by random actions.
Under distractors the policy sees the clean observation, for it was trained on that.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import pixelbrax_jax as pb
from pixelbrax_jax.distractors import Video
from pixelbrax_jax.distractors.presets import resolve

SIZE = 120  # pixels of a tile
GAP = 4
CAPTION = 16
COLUMNS = 5
VIEWS = {
    "default": {},
    "shadows": {"shadows": True},
    "original": {"look": "original"},
    "side": {"camera": "side"},
    "front": {"camera": "front"},
    "top": {"camera": "top"},
}
"""Looks and cameras, and the options that they take."""
SHADOWS = pb.make_look("default", shadows=True)
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

DMC_TILES: tuple[tuple[str, str | None], ...] = (
    ("dmc_acrobot_swingup", None),
    ("dmc_ball_in_cup_catch", None),
    ("dmc_cartpole_swingup", None),
    ("dmc_cheetah_run", None),
    ("dmc_finger_spin", None),
    ("dmc_fish_swim", None),
    ("dmc_hopper_hop", None),
    ("dmc_humanoid_walk", None),
    ("dmc_manipulator_bring_ball", None),
    ("dmc_quadruped_walk", None),
    ("dmc_reacher_easy", None),
    ("dmc_swimmer_swimmer6", None),
    ("dmc_walker_walk", None),
    ("dmc_walker_walk", "dcs-medium"),
    ("dmc_cheetah_run", "video-hard"),
)
"""The same of the DM Control Suite."""


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
        look="default" if task in pb.list_envs(suite="dmc") else SHADOWS,
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


def named(name: str, frames: np.ndarray) -> np.ndarray:
    """Frames with a name below, (T, SIZE + CAPTION, SIZE, 3) uint8."""
    caption = Image.new("RGB", (SIZE, CAPTION), "white")
    font = ImageFont.load_default(size=11 if len(name) < 20 else 9)
    ImageDraw.Draw(caption).text((SIZE / 2, CAPTION / 2), name, "black", font, anchor="mm")
    below = np.broadcast_to(np.asarray(caption), (len(frames), CAPTION, SIZE, 3))
    return np.concatenate([frames, below], axis=1)


def views(task: str, states: Any) -> np.ndarray:
    """The first state in every look and from every camera, in a row, (H, W, 3) uint8."""
    first = jax.tree.map(lambda x: x[0], states)
    images = []
    for options in VIEWS.values():
        env, params = pb.make(task, **options)
        images.append(np.asarray(env.image(first, params, SIZE, SIZE)))
    gap = np.full((SIZE, GAP, 3), 255, np.uint8)
    return np.concatenate([part for image in images for part in (image, gap)][:-1], axis=1)


def save(frames: np.ndarray, path: Path) -> None:
    """Write a GIF whose frames have one palette."""
    sample = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 6)]))
    # Octrees keep rare colors, such as the red of targets.
    palette = sample.quantize(COLORS, method=Image.Quantize.FASTOCTREE)
    images = [
        Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames
    ]
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 // FPS, loop=0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes ``wall.gif``, ``tasks/<task>.gif`` and ``views.png``, or ``dmc/wall.gif``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output-dir", type=Path, default=Path("docs/images"))
    parser.add_argument("--num-frames", type=int, default=60)
    tasks = pb.list_envs(suite="brax")
    parser.add_argument("--suite", choices=("brax", "dmc"), default="brax")
    parser.add_argument("--only", nargs="+", default=tasks, choices=tasks, help="tasks of Brax")
    options = parser.parse_args(arguments)
    if options.suite == "dmc":
        if options.only is not tasks:
            parser.error("--only is for --suite brax")
        (options.output_dir / "dmc").mkdir(parents=True, exist_ok=True)
        states = {task: episode(task, options.num_frames) for task, _ in DMC_TILES}
        tiles = [tile(task, behind, states[task], 0) for task, behind in DMC_TILES]
        save(wall(tiles), options.output_dir / "dmc" / "wall.gif")
        return
    (options.output_dir / "tasks").mkdir(parents=True, exist_ok=True)
    states = {task: episode(task, options.num_frames) for task in options.only}
    clean = {task: tile(task, None, states[task], 0) for task in states}
    for task, frames in clean.items():
        save(named(task, frames), options.output_dir / "tasks" / f"{task}.gif")
    tiles = [
        tile(task, behind, states[task], seed) if behind else clean[task]
        for seed, (task, behind) in enumerate(TILES)
        if task in states
    ]
    if tiles:
        save(wall(tiles), options.output_dir / "wall.gif")
    first = next(iter(states))
    shown = "ant" if "ant" in states else first
    Image.fromarray(views(shown, states[shown])).save(options.output_dir / "views.png")


if __name__ == "__main__":
    main()
