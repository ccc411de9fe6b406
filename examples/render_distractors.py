"""Images of every distractor at every level, for the documentation.

    python examples/render_distractors.py --output-dir docs/images/distractors

Real observations of HalfCheetah and Ant under procedural clips: ``levels.png`` has a row for each
preset and a column for each of six environments, ``motion.webp`` shows some of them in time.
``--tasks ant --presets dcs-easy dcs-hard --num-frames 8`` draws fewer in less time.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

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
    **{f"camera, {scale}": (distractors.MovingCamera(scale=scale),) for scale in (0.1, 0.2, 0.3)},
    **{name: (name,) for name in ("light", "dcs-easy", "dcs-medium", "dcs-hard")},
}
# Not paper-color: it flashes, up to twenty times a second.
MOVING = ("paper-video", "video-easy", "video-hard", "dcs-easy", "dcs-medium", "dcs-hard")
TASKS = ("halfcheetah", "ant")
EACH = 3  # environments of a task
SIZE = 84  # pixels that agents get
SHOWN = 8  # the frame in levels.png: by then what moves has moved
SEED = 4  # agents of this one do not stretch beyond the image
STAR = 2  # the environment in motion.webp: its viewpoint strays further with every level

ZOOM, GAP, CAPTION = 2, 4, 20  # pixels in motion.webp
QUALITY = 80  # of 100


def simulate(task: str, num_frames: int) -> Any:
    """States of ``EACH`` environments under random actions, (N, num_frames, ...)."""
    env, params = pixelbrax_jax.make(task, obs_mode="state")

    def run(key):
        def step(state, key):
            action = jax.random.uniform(key, (env.action_size,), minval=-1.0)
            return env.step(state, action, params)[0], state

        keys = jax.random.split(jax.random.fold_in(key, 1), num_frames)
        return jax.lax.scan(step, env.reset(key, params)[0], keys)[1]

    return jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(SEED), EACH))


def play(task: str, links: tuple, states: Any) -> np.ndarray:
    """What the agent sees of states, (num_frames, N, SIZE, SIZE, 3) uint8."""
    links = resolve(links, task)
    plays = any(isinstance(link, distractors.Video) for link in links)
    clips = "procedural" if plays else None
    env, params = pixelbrax_jax.make(
        task, distractors=links, clips=clips, frame_stack=1, height=SIZE, width=SIZE
    )
    chain = env.chain

    def run(states, params):
        key = jax.random.fold_in(states.key[0], 0)  # that of the first episode

        def step(distractor_state, state):
            later = chain.advance(distractor_state, key, state.sim.step_count + 1, params)
            shown = state.replace(sim=state.sim.replace(distractor_state=distractor_state))
            return later, env.image(shown, params)

        return jax.lax.scan(step, chain.reset(key, params), states)[1]

    return np.asarray(jax.jit(jax.vmap(run, in_axes=(0, None), out_axes=1))(states, params))


def levels(frames: dict[str, np.ndarray], path: Path) -> None:
    """One row for each preset, with its name; ``frames`` are (num_frames, columns, ...)."""
    num_frames, columns = next(iter(frames.values())).shape[:2]
    figure, grid = plt.subplots(
        len(frames), columns, figsize=(columns * 1.15 + 1.6, len(frames) * 1.15), squeeze=False
    )
    for row, (name, images) in enumerate(frames.items()):
        for column, image in enumerate(images[min(SHOWN, num_frames - 1)]):
            panel = grid[row, column]
            panel.imshow(image, interpolation="nearest")
            panel.set(xticks=[], yticks=[])
            for side in panel.spines.values():
                side.set_visible(False)
        grid[row, 0].set_ylabel(name, rotation=0, ha="right", va="center")
    figure.subplots_adjust(
        left=1.6 / figure.get_figwidth(),
        right=0.995,
        top=0.998,
        bottom=0.002,
        wspace=0.03,
        hspace=0.03,
    )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def motion(frames: dict[str, np.ndarray], path: Path) -> None:
    """Presets side by side, each below its name, in time; a row for each task."""
    font = ImageFont.load_default(size=14)
    side = ZOOM * SIZE
    videos = {name: video[:, STAR::EACH] for name, video in frames.items()}
    num_frames, rows = next(iter(videos.values())).shape[:2]
    width = len(videos) * (side + GAP) - GAP
    images = []
    for t in range(num_frames):
        image = Image.new("RGB", (width, CAPTION + rows * (side + GAP) - GAP), "white")
        drawing = ImageDraw.Draw(image)
        for column, (name, video) in enumerate(videos.items()):
            left = column * (side + GAP)
            drawing.text((left + side / 2, CAPTION / 2), name, "black", font, anchor="mm")
            for row, pixels in enumerate(video[t]):
                tile = pixels.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
                image.paste(Image.fromarray(tile), (left, CAPTION + row * (side + GAP)))
        images.append(image)
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=80, loop=0, quality=QUALITY
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes both images."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    default = "default: docs/images/distractors, or runs/images/distractors for a part of them"
    parser.add_argument("--output-dir", type=Path, help=default)
    parser.add_argument("--num-frames", type=int, default=18)
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=pixelbrax_jax.list_envs())
    parser.add_argument("--presets", nargs="+", default=list(ROWS), choices=list(ROWS))
    options = parser.parse_args(arguments)
    whole = options == parser.parse_args([])
    images = Path("docs/images" if whole else "runs/images")
    folder = options.output_dir or images / "distractors"
    folder.mkdir(parents=True, exist_ok=True)
    states = {task: simulate(task, options.num_frames) for task in options.tasks}
    frames = {
        name: np.concatenate([play(task, ROWS[name], states[task]) for task in states], axis=1)
        for name in options.presets
    }
    levels(frames, folder / "levels.png")
    moving = {name: video for name, video in frames.items() if name in MOVING}
    motion(moving or frames, folder / "motion.webp")


if __name__ == "__main__":
    main()
