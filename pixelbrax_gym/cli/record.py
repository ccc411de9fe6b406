"""Record a video of a trained agent."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import parse, say
from pixelbrax_gym.cli._agents import AgentOptions, load
from pixelbrax_gym.resets import check_seed
from pixelbrax_jax.validation import check_positive_int
from pixelbrax_jax.video import check_suffix, write_frames

if TYPE_CHECKING:
    import numpy as np

    from pixelbrax_jax.agents.runner.trained import Trained


@dataclass(frozen=True)
class Options(AgentOptions):
    """Plays several episodes with a checkpoint side by side and writes a video."""

    folder: Annotated[Positional[str | None], arg(metavar="FOLDER")] = None
    """Output folder of the training run."""
    output: str | None = None
    """Path of the .mp4 or .gif; default: videos/<steps>_<split>.mp4 in the folder."""
    split: str | None = None
    """Split: clean, train or test; default: train, or clean without distractors."""
    grid: int = 3
    """Rows and columns of episodes."""
    size: int = 168
    """Height and width of one episode in pixels."""
    num_frames: int = 300
    """Maximum number of frames."""
    seed: int = 0
    """Seed of the episodes."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("record", Options, arguments)
    from pixelbrax_jax.memory import check_fits

    for name in ("grid", "size", "num_frames"):
        check_positive_int(name, getattr(options, name))
    check_seed(options.seed)
    check_fits(
        f"a frame with size={options.size}, grid={options.grid}",
        3 * (options.size * options.grid) ** 2,
    )
    if options.output is not None:
        check_suffix(Path(options.output))
    agent = load(options, options.folder)
    from pixelbrax_jax.agents.runner.splits import make_split, splits_of
    from pixelbrax_jax.agents.runner.trained import with_clips

    has_train = "train" in splits_of(agent.algorithm.config)
    split = options.split or ("train" if has_train else "clean")
    config, shown = with_clips(agent, options.clips)
    env, params = make_split(config, split, shown)
    run = [f"run{options.run_index}"] if options.run_index else []
    name = "_".join([options.pretrained or str(agent.steps), split, *run])
    path = options.output or Path(options.folder or "") / "videos" / f"{name}.mp4"
    fps = min(max(1, round(1.0 / env.dt)), 60)
    episodes = options.grid**2
    say(
        "record",
        f"{options.num_frames} frames of {episodes} episodes, after up to a minute of compilation",
    )
    sys.stdout.write(f"{write_frames(path, _frames(agent, env, params, options), fps)}\n")
    return 0


def _frames(agent: Trained, env: Any, params: Any, options: Options) -> Iterator[np.ndarray]:
    """Play episodes with mean actions; yield frames with all of them, in rows and columns."""
    import jax
    import numpy as np

    from pixelbrax_jax import VectorPixelEnv, compiler_options
    from pixelbrax_jax.flags import default_flags

    grid, size = options.grid, options.size
    envs = VectorPixelEnv(env, grid * grid)

    @partial(jax.jit, compiler_options=compiler_options(env))
    def step(state: Any, params: Any) -> tuple[Any, jax.Array]:
        action = agent.algorithm.act(agent.networks, envs.obs(state))
        state, _ = envs.step(state, action, params)
        draw = jax.vmap(lambda state: env.image(state, params, size, size))
        return state, draw(state)

    with default_flags():
        key = jax.random.key(options.seed)
    state, _ = envs.reset(key, params)
    for _ in range(options.num_frames):
        state, images = step(state, params)
        tiles = jax.device_get(images).reshape(grid, grid, size, size, 3)
        yield np.concatenate(np.concatenate(tiles, axis=1), axis=1)
