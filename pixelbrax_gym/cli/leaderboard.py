"""Add training runs to the leaderboard, and show it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import CommandError, parse, say
from pixelbrax_jax.extras import needs_extra


@dataclass(frozen=True)
class Options:
    """Writes an entry for each run into a folder, and the table of all its entries to stdout.

    A run needs evaluations: train with --num-evals 40, one run at a time on an idle machine.
    """

    runs: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN")] = ()
    """Output folders of training runs."""
    folder: str = "docs/leaderboard"
    """Folder of the entries."""
    agent: str | None = None
    """Name of the agent in the table; default: its algorithm."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("leaderboard", Options, arguments)
    with needs_extra("train"):
        from pixelbrax_gym.cli._leaderboard import add, entry, page
        from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
    try:
        entries = [entry(folder, options.agent) for folder in options.runs]
    except CheckpointError as error:
        raise CommandError(str(error)) from error
    for one in entries:
        say("leaderboard", f"wrote {add(one, options.folder)}")
    sys.stdout.write(page(options.folder) + "\n")
    return 0
