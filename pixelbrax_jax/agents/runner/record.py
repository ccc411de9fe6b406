"""``pixelbrax record``: a trained agent on film."""

from __future__ import annotations

import argparse
import sys
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import jax
import numpy as np

from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
from pixelbrax_jax.agents.runner.evaluate import SPLITS, make_split
from pixelbrax_jax.agents.runner.trained import load_trained
from pixelbrax_jax.compilation import compiler_options
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.validation import check_choice, check_positive_int


def record(options: argparse.Namespace) -> int:
    """Run the command; see ``pixelbrax record --help``.

    Returns:
        The exit status.
    """
    try:
        path = film(
            options.folder,
            output=options.output,
            steps=options.steps,
            best=options.best,
            split=options.split,
            grid=options.grid,
            size=options.size,
            num_frames=options.num_frames,
            seed=options.seed,
            run=options.run_index,
        )
    except (CheckpointError, ValueError, OSError, ImportError) as error:
        sys.stderr.write(f"pixelbrax record: {error}\n")
        return 1
    sys.stdout.write(f"{path}\n")
    return 0


def film(
    folder: str | Path,
    *,
    output: str | Path | None = None,
    steps: int | None = None,
    best: bool = False,
    split: str | None = None,
    grid: int = 3,
    size: int = 168,
    num_frames: int = 300,
    seed: int = 0,
    run: int = 0,
) -> Path:
    """Write an MP4 of ``grid`` x ``grid`` episodes, side by side.

    Args:
        folder: output folder of a training run.
        output: of the film; None puts it into the run's folder.
        steps: of which checkpoint; None takes the latest.
        best: whether instead the best checkpoint is taken.
        split: ``"clean"``, ``"train"`` or ``"test"``; None takes that of the training.
        grid: episodes a side.
        size: pixels of one episode, square.
        num_frames: at most.
        seed: of the episodes.
        run: which of several runs that were trained together, from 0.

    Returns:
        The film's path.

    Raises:
        CheckpointError: there is no such checkpoint.
        ValueError: an option is out of range.
    """
    check_positive_int("grid", grid)
    check_positive_int("size", size)
    check_positive_int("num_frames", num_frames)
    if split is not None:
        check_choice("split", split, SPLITS)
    agent = load_trained(folder, steps=steps, best=best, run=run)
    algorithm, networks = agent.algorithm, agent.networks
    split = split or ("train" if algorithm.config.distractors else "clean")
    env, params = make_split(algorithm.config, split)
    envs = VectorPixelEnv(env, grid * grid)

    @partial(jax.jit, compiler_options=compiler_options())
    def step(state: Any, params: Any) -> tuple[Any, jax.Array]:
        action = algorithm.act(networks, envs.obs(state))
        state, _ = envs.step(state, action, params)
        draw = jax.vmap(lambda state: env.image(state, params, size, size))
        return state, draw(state)

    name = "_".join([str(agent.steps), split, *([f"run{run}"] if run else [])])
    path = Path(output) if output else Path(folder) / "videos" / f"{name}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    state, _ = envs.reset(jax.random.key(seed), params)
    fps = max(1, round(1.0 / env.dt))
    writer: Any = imageio.get_writer(path, fps=min(fps, 60), macro_block_size=1)
    with writer, warnings.catch_warnings():
        # Python warns of a fork beside JAX's threads; the child becomes ffmpeg at once.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        for _ in range(num_frames):
            state, images = step(state, params)
            tiles = np.asarray(images).reshape(grid, grid, size, size, 3)
            writer.append_data(np.concatenate(np.concatenate(tiles, axis=1), axis=1))
    return path
