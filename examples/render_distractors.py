"""Pictures of every distractor at every level, for the documentation.

    python examples/render_distractors.py --output-dir docs/images/distractors

Real observations of HalfCheetah and Ant under procedural clips: ``levels.png`` has a row for each
preset and a column for each of six environments, ``motion.gif`` shows some of them in time.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from PIL import Image

import pixelbrax_jax
from pixelbrax_jax import distractors
from pixelbrax_jax.distractors.presets import resolve

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROWS: dict[str, tuple] = {
    "none": (),
    **{name: (name,) for name in ("paper-color", "paper-video", "video-easy", "video-hard")},
    **{
        f"color, geom, {scale}": (distractors.Color("geom", "walk", scale, "uniform"),)
        for scale in (0.1, 0.2, 0.3)
    },
    **{f"camera, {scale}": (distractors.Camera(scale=scale),) for scale in (0.1, 0.2, 0.3)},
    **{name: (name,) for name in ("dcs-easy", "dcs-medium", "dcs-hard")},
}
MOVING = ("paper-color", "paper-video", "video-hard", "dcs-easy", "dcs-medium", "dcs-hard")
TASKS = ("halfcheetah", "ant")
COLUMNS = 6


def simulate(task: str, num_frames: int) -> Any:
    """States of ``COLUMNS / 2`` environments under random actions, (N, num_frames, ...)."""
    env, params = pixelbrax_jax.make(task, obs_mode="state")

    def run(key):
        def step(state, key):
            action = jax.random.uniform(key, (env.action_size,), minval=-1.0)
            return env.step(state, action, params)[0], state

        keys = jax.random.split(jax.random.fold_in(key, 1), num_frames)
        return jax.lax.scan(step, env.reset(key, params)[0], keys)[1]

    return jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(1), COLUMNS // 2))


def play(task: str, links: tuple, states: Any) -> np.ndarray:
    """What the agent sees of states, (num_frames, N, 84, 84, 3) uint8."""
    links = resolve(links, task)
    plays = any(isinstance(link, distractors.Video) for link in links)
    clips = "procedural" if plays else None
    env, params = pixelbrax_jax.make(task, distractors=links, clips=clips, frame_stack=1)
    chain = env.distractors

    def run(states, params):
        key = jax.random.fold_in(states.key[0], 0)  # that of the first episode

        def step(distraction, state):
            later = chain.advance(distraction, key, state.step_count + 1, params)
            return later, env.picture(state.replace(distraction=distraction), params)

        return jax.lax.scan(step, chain.begin(key, params), states)[1]

    return np.asarray(jax.jit(jax.vmap(run, in_axes=(0, None), out_axes=1))(states, params))


def levels(frames: dict[tuple[str, str], np.ndarray], path: Path) -> None:
    """One row for each preset, with its name."""
    figure, grid = plt.subplots(
        len(ROWS), COLUMNS, figsize=(COLUMNS * 1.15 + 1.6, len(ROWS) * 1.15), squeeze=False
    )
    for row, name in enumerate(ROWS):
        pictures = [
            picture
            for task in TASKS
            for picture in frames[task, name][min(8, len(frames[task, name]) - 1)]
        ]
        for column, picture in enumerate(pictures):
            panel = grid[row, column]
            panel.imshow(picture, interpolation="nearest")
            panel.set(xticks=[], yticks=[])
            for side in panel.spines.values():
                side.set_visible(False)
        label = {"rotation": 0, "ha": "right", "va": "center"}
        grid[row, 0].set_ylabel(name, **label)
    figure.subplots_adjust(
        left=0.19, right=0.995, top=0.998, bottom=0.002, wspace=0.03, hspace=0.03
    )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def motion(frames: dict[tuple[str, str], np.ndarray], path: Path) -> None:
    """Some presets side by side, in time."""
    rows = [[frames[task, name][:, 0] for name in MOVING] for task in TASKS]
    film = np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)
    pictures = [
        Image.fromarray(picture).resize(
            (picture.shape[1] * 3 // 2, picture.shape[0] * 3 // 2), Image.Resampling.NEAREST
        )
        for picture in film
    ]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=60, loop=0)


def main(arguments: list[str] | None = None) -> None:
    """Writes both pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output-dir", type=Path, default=Path("docs/images/distractors"))
    parser.add_argument("--num-frames", type=int, default=24)
    options = parser.parse_args(arguments)
    options.output_dir.mkdir(parents=True, exist_ok=True)
    frames = {}
    for task in TASKS:
        states = simulate(task, options.num_frames)
        frames |= {(task, name): play(task, links, states) for name, links in ROWS.items()}
    levels(frames, options.output_dir / "levels.png")
    motion(frames, options.output_dir / "motion.gif")


if __name__ == "__main__":
    main()
