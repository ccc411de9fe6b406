"""Make a video of a trained agent."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

from pixelbrax_gym.cli import needs_extra, parse
from pixelbrax_gym.cli.evaluate import AgentOptions


@dataclass(frozen=True)
class Options(AgentOptions):
    """Plays several episodes of a checkpoint side by side and writes an MP4."""

    output: str | None = None
    """An .mp4 or .gif; videos/<steps>_<split>.mp4 in the folder by default."""
    split: str | None = None
    """clean, train or test; by default train, or clean without distractors."""
    grid: int = 3
    """Episodes a side."""
    size: int = 168
    """Pixels of one episode, square."""
    num_frames: int = 300
    """At most."""
    seed: int = 0
    """Of the episodes."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("record", Options, arguments)
    with needs_extra("train"):
        from pixelbrax_jax.agents.runner.record import record
    return record(argparse.Namespace(**vars(options)))
