"""Measure the returns of a trained agent."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import needs_extra, parse


@dataclass(frozen=True)
class AgentOptions:
    """Which trained agent."""

    folder: Annotated[Positional[str | None], arg(metavar="FOLDER")] = None
    """Output folder of a training run."""
    pretrained: str | None = None
    """In its place a policy that comes with the package, as halfcheetah."""
    steps: int | None = None
    """Of which checkpoint; the latest by default."""
    clips: str | None = None
    """Folder of the clips, where it is not that of the training; for train it must hold the same
    clips."""
    best: bool = False
    """Take the best checkpoint."""
    run_index: Annotated[int, arg(name="run")] = 0
    """Which of the runs of --seeds, from 0."""


@dataclass(frozen=True)
class Options(AgentOptions):
    """Plays whole episodes of a checkpoint, and writes a line of JSON for each split.

    Actions are the means of the policy, and the episodes the same every time.
    """

    episodes: int = 32
    """Of each split."""
    split: tuple[Literal["clean", "train", "test"], ...] = ()
    """By default clean, with distractors train too, and test where there are clips that training
    never shows."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("evaluate", Options, arguments)
    with needs_extra("train"):
        from pixelbrax_jax.agents.runner.evaluate_command import evaluate
    return evaluate(argparse.Namespace(**vars(options)))
