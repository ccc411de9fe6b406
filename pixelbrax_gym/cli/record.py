"""Record a video of a trained agent."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pixelbrax_gym.cli import parse
from pixelbrax_gym.cli.evaluate import AgentOptions, load


@dataclass(frozen=True)
class Options(AgentOptions):
    """Plays several episodes with a checkpoint side by side and writes a video."""

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
    agent = load(options)
    from pixelbrax_jax.agents.runner.record import write_video

    split = options.split or ("train" if agent.algorithm.config.env.distractors else "clean")
    run = [f"run{options.run_index}"] if options.run_index else []
    name = "_".join([options.pretrained or str(agent.steps), split, *run])
    path = write_video(
        agent,
        options.output or Path(options.folder or "") / "videos" / f"{name}.mp4",
        split=split,
        clips=options.clips,
        grid=options.grid,
        size=options.size,
        num_frames=options.num_frames,
        seed=options.seed,
    )
    sys.stdout.write(f"{path}\n")
    return 0
