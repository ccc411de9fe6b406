"""Measure the returns of a trained agent."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import CommandError, needs_extra, parse, say
from pixelbrax_jax.validation import check_positive_int

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

    def load(self) -> Trained:
        """Return the agent.

        Raises:
            CommandError: there is no such checkpoint.
            ValueError: options do not go together, or are out of range.
        """
        with needs_extra("train"):
            from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
            from pixelbrax_jax.agents.runner.trained import load_pretrained, load_trained

        if (self.folder is None) == (self.pretrained is None):
            raise ValueError(
                "give the folder of a run, or --pretrained and a name: one of the two."
            )
        if self.pretrained is None:
            try:
                return load_trained(
                    str(self.folder), steps=self.steps, best=self.best, run=self.run_index
                )
            except CheckpointError as error:
                raise CommandError(str(error)) from error
        if self.steps is not None or self.best or self.run_index:
            raise ValueError(
                "--steps, --best and --run choose of a run's folder, not of --pretrained."
            )
        return load_pretrained(self.pretrained)


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
    check_positive_int("episodes", options.episodes)
    agent = options.load()
    from pixelbrax_jax.agents.runner.evaluate import Evaluator, NoSplitError, make_split, splits_of
    from pixelbrax_jax.agents.runner.settings import place_of
    from pixelbrax_jax.agents.runner.trained import with_clips

    config, shown = with_clips(agent, options.clips)
    if options.clips and not shown:
        say(
            "evaluate",
            f"the run has no digest of its clips; those of {options.clips} are taken for them",
        )
    for name in options.split or splits_of(config):
        try:
            env, params = make_split(config, name, shown)
        except NoSplitError as error:
            if options.split:
                raise
            say("evaluate", f"no split {name!r}: {error}")
            continue
        evaluator = Evaluator(agent.algorithm, env, params, num_episodes=options.episodes)
        result = evaluator(agent.networks)
        line = {
            "steps": agent.steps,
            "seed": agent.seed,
            "split": name,
            "episodes": options.episodes,
            "return": result.mean,
            "length": float(result.lengths.mean()),
        }
        if params.clips is not None:
            line["clips"] = place_of(str(config.env.clips or "procedural"))
        if options.episodes > 1:
            line["standard_error"] = result.standard_error
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0
