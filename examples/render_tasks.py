"""The documentation's images of tasks: a wall of them, one animation of each, looks and cameras.

    python examples/render_tasks.py --output-dir docs/images
    python examples/render_tasks.py --output-dir runs/images --num-frames 8 --only ant reacher
    python examples/render_tasks.py --output-dir docs/images --suite dmc

Tasks for which a policy comes with the package are played by it, the others by random actions. An
episode that ends is followed by the next. Time passes as in the simulation.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import pixelbrax_jax as pb

SIZE = 120  # pixels of a tile
GAP = 4
CAPTION = 16
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
FPS = 20
QUALITY = 80  # of 100, of WebP
WARM_UP = 1.0  # seconds before the first frame that is shown: by then agents are under way

TRAINED = (
    *("halfcheetah", "ant", "humanoid", "walker2d"),
    *("dmc_walker_walk", "dmc_walker_stand", "dmc_ball_in_cup_catch", "dmc_reacher_easy"),
)
"""Tasks of ``wall.webp``, row by row."""

DMC_TILES = (
    *("acrobot_swingup", "ball_in_cup_catch", "cartpole_swingup", "cheetah_run", "finger_spin"),
    *("fish_swim", "hopper_hop", "humanoid_walk", "manipulator_bring_ball", "pendulum_swingup"),
    *("point_mass_easy", "quadruped_walk", "reacher_easy", "swimmer_swimmer6", "walker_walk"),
)
"""Tasks of ``dmc/wall.webp``."""


def episode(task: str, num_frames: int) -> Any:
    """States of episodes, one for each frame of an animation, (T, ...)."""
    policy = pb.load_policy(task) if task in pb.list_pretrained() else None
    random = {"task": task, "obs_mode": "state"}
    env, params = pb.make(**((policy and policy.env_options) or random))

    def step(carry, key):
        state, obs = carry
        if policy:
            action = policy.program(obs[None])[0]
        else:
            action = jax.random.uniform(key, (env.action_size,), minval=-1.0)
        after, timestep = jax.lax.cond(
            state.done,
            lambda: env.next_episode(state, params),
            lambda: env.step(state, action, params),
        )
        return (after, timestep.obs), state

    seconds = WARM_UP + np.arange(num_frames) / FPS
    shown = jnp.asarray(seconds / env.dt, jnp.int32)

    def run(key):
        state, timestep = env.reset(key, params)
        keys = jax.random.split(key, int(seconds[-1] / env.dt) + 1)
        states = jax.lax.scan(step, (state, timestep.obs), keys)[1]
        return jax.tree.map(lambda x: x[shown], states)

    return jax.jit(run)(jax.random.key(0))


def tile(task: str, states: Any) -> np.ndarray:
    """One tile's frames, (T, SIZE, SIZE, 3) uint8."""
    look = "default" if task in pb.list_envs(suite="dmc") else SHADOWS
    env, params = pb.make(task, height=SIZE, width=SIZE, look=look)
    draw = jax.jit(lambda states: jax.lax.map(lambda state: env.image(state, params), states))
    return np.asarray(draw(states))


def wall(tiles: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Tiles in rows, (T, H, W, 3) uint8."""
    columns = min(columns, len(tiles))
    padded = [np.pad(t, ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255) for t in tiles]
    padded += [np.full_like(padded[0], 255)] * (-len(padded) % columns)
    rows = [np.concatenate(padded[k : k + columns], axis=2) for k in range(0, len(padded), columns)]
    return np.concatenate(rows, axis=1)[:, :-GAP, :-GAP]


def named(name: str, frames: np.ndarray) -> np.ndarray:
    """Frames with a name below, (T, SIZE + CAPTION, SIZE, 3) uint8."""
    caption = Image.new("RGB", (SIZE, CAPTION), "white")
    fonts = map(ImageFont.load_default, range(11, 4, -1))
    font = next(font for font in fonts if font.getlength(name) <= SIZE)
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
    """Write a WebP animation that is repeated."""
    images = [Image.fromarray(f) for f in frames]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=1000 // FPS, loop=0, quality=QUALITY
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes ``wall.webp``, ``tasks/<task>.webp`` and ``views.png``, or ``dmc/wall.webp``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    default = "default: docs/images, or runs/images for a part of them"
    parser.add_argument("--output-dir", type=Path, help=default)
    parser.add_argument("--num-frames", type=int, default=60)
    tasks = pb.list_envs(suite="brax")
    parser.add_argument("--suite", choices=("brax", "dmc"), default="brax")
    parser.add_argument("--only", nargs="+", default=tasks, choices=tasks, help="tasks of Brax")
    options = parser.parse_args(arguments)
    whole = options == parser.parse_args(["--suite", options.suite])
    folder = options.output_dir or Path("docs/images" if whole else "runs/images")

    def played(names: Sequence[str]) -> dict[str, Any]:
        return {task: episode(task, options.num_frames) for task in names}

    def animated(states: dict[str, Any]) -> dict[str, np.ndarray]:
        return {task: named(task, tile(task, those)) for task, those in states.items()}

    if options.suite == "dmc":
        if options.only is not tasks:
            parser.error("--only is for --suite brax")
        (folder / "dmc").mkdir(parents=True, exist_ok=True)
        tiles = animated(played([f"dmc_{task}" for task in DMC_TILES]))
        save(wall(list(tiles.values()), 5), folder / "dmc" / "wall.webp")
        return
    (folder / "tasks").mkdir(parents=True, exist_ok=True)
    states = played(options.only)
    animations = animated(states)
    for task, frames in animations.items():
        save(frames, folder / "tasks" / f"{task}.webp")
    if options.only is tasks:
        animations |= animated(played([task for task in TRAINED if task not in tasks]))
    if tiles := [animations[task] for task in TRAINED if task in animations]:
        save(wall(tiles, 4), folder / "wall.webp")
    shown = "ant" if "ant" in animations else options.only[0]
    images = views(shown, states[shown])
    Image.fromarray(images).save(folder / "views.png")


if __name__ == "__main__":
    main()
