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
    """Options that select a trained agent."""

    folder: Annotated[Positional[str | None], arg(metavar="FOLDER")] = None
    """Output folder of the training run."""
    pretrained: str | None = None
    """Loads a policy of the package instead, by its task, such as halfcheetah."""
    steps: int | None = None
    """Loads the checkpoint of this many steps; default: the latest."""
    clips: str | None = None
    """Folder of the clips; default: the folder used in training. Split train needs the same
    clips."""
    best: bool = False
    """Loads the best checkpoint."""
    run_index: Annotated[int, arg(name="run")] = 0
    """Index of the run among those of --seeds, from 0."""


@dataclass(frozen=True)
class Options(AgentOptions):
    """Plays whole episodes with a checkpoint and writes a line of JSON for each split.

    Actions are the policy's means. Every call plays the same episodes.
    """

    episodes: int = 32
    """Number of episodes of each split."""
    split: tuple[Literal["clean", "train", "test"], ...] = ()
    """Splits to evaluate; default: clean, with distractors also train, and test if it has clips
    that training does not show."""


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
    """Load the agent that the options select; raise a CommandError if its checkpoint is missing."""
    with needs_extra("train"):
        from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
        from pixelbrax_jax.agents.runner.trained import load_pretrained, load_trained
    steps, best, run = options.steps, options.best, options.run_index
    if options.folder is not None and options.pretrained is None:
        try:
            return load_trained(options.folder, steps=steps, best=best, run=run)
        except CheckpointError as error:
            raise CommandError(str(error)) from error
    if options.folder is not None or options.pretrained is None:
        raise ValueError("give either the folder of a run or --pretrained with a name.")
    if steps is not None or best or run:
        raise ValueError("--steps, --best and --run need the folder of a run, not --pretrained.")
    return load_pretrained(options.pretrained)
