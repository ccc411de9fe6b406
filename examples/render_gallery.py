"""One real frame per task, for the gallery of the documentation.

    python examples/render_gallery.py --output-dir docs/images/gallery
    python examples/render_gallery.py --output-dir runs/gallery --tasks ant reacher

Each image is the environment's after a few random actions; the strip shows, side by side, what
the agent gets (84 x 84, enlarged), the default look with shadows, and the original look.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import imageio.v2 as imageio
import jax
import numpy as np

import pixelbrax_jax

SIZE = 336  # four times the 84 pixels that agents get
GAP = 8


def strip(task: str, num_steps: int) -> np.ndarray:
    """The task's three images side by side, (SIZE, 3 SIZE + gaps, 3) uint8."""
    env, params = pixelbrax_jax.make(task, obs_mode="state")
    key = jax.random.key(1)
    state, _ = env.reset(key, params)
    for t in range(num_steps):
        shape = (env.action_size,)
        action = jax.random.uniform(jax.random.fold_in(key, t), shape, minval=-1.0)
        state, _ = env.step(state, action, params)
    images = []
    for look, shadows, size in (
        ("default", False, 84),
        ("default", True, SIZE),
        ("original", False, SIZE),
    ):
        dressed = params.replace(look=pixelbrax_jax.make_look(look, shadows=shadows))
        pixels = np.asarray(env.image(state, dressed, size, size))
        images.append(pixels.repeat(SIZE // size, axis=0).repeat(SIZE // size, axis=1))
    gap = np.full((SIZE, GAP, 3), 255, np.uint8)
    return np.concatenate([images[0], gap, images[1], gap, images[2]], axis=1)


def overview(strips: list[np.ndarray], columns: int = 6) -> np.ndarray:
    """The middle images of all strips at half size, in rows of at most ``columns``."""
    start, columns = SIZE + GAP, min(columns, len(strips))
    tiles = [image[::2, start : start + SIZE : 2] for image in strips]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
    return np.concatenate(rows, axis=0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes one PNG a task, and one of all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output-dir", default="docs/images/gallery")
    parser.add_argument("--num-steps", type=int, default=8)
    tasks = pixelbrax_jax.list_envs()
    parser.add_argument("--tasks", nargs="+", default=tasks, choices=tasks)
    options = parser.parse_args(arguments)
    output = Path(options.output_dir)
    output.mkdir(parents=True, exist_ok=True)
    strips = {task: strip(task, options.num_steps) for task in options.tasks}
    for task, image in strips.items():
        imageio.imwrite(output / f"{task}.png", image)
    imageio.imwrite(output / "overview.png", overview(list(strips.values())))


if __name__ == "__main__":
    main()
