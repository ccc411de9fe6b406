"""Measure the returns of a trained agent."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import CommandError, needs_extra, parse, say

if TYPE_CHECKING:
    from pixelbrax_jax.agents.runner.trained import Trained


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
    agent = load(options)
    from pixelbrax_jax.agents.runner.evaluate import evaluate

    for row in evaluate(
        agent,
        episodes=options.episodes,
        splits=options.split,
        clips=options.clips,
        report=partial(say, "evaluate"),
    ):
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    return 0


def load(options: AgentOptions) -> Trained:
    """Return the agent that options choose.

    Raises:
        CommandError: there is no such checkpoint.
        ValueError: options do not go together, or are out of range.
    """
    with needs_extra("train"):
        from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
        from pixelbrax_jax.agents.runner.trained import load_agent
    try:
        return load_agent(
            options.folder,
            options.pretrained,
            steps=options.steps,
            best=options.best,
            run=options.run_index,
        )
    except CheckpointError as error:
        raise CommandError(str(error)) from error
