"""``pixelbrax evaluate``: returns of a trained agent."""

from __future__ import annotations

import argparse
import json
import sys

from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
from pixelbrax_jax.agents.runner.evaluate import evaluate as rows
from pixelbrax_jax.agents.runner.trained import load_agent


def evaluate(options: argparse.Namespace) -> int:
    """Run the command; see ``pixelbrax evaluate --help``.

    Returns:
        The exit status.
    """
    try:
        agent = load_agent(
            options.folder,
            options.pretrained,
            steps=options.steps,
            best=options.best,
            run=options.run_index,
        )
        for row in rows(
            agent,
            episodes=options.episodes,
            splits=options.split or (),
            clips=options.clips,
            report=lambda line: sys.stderr.write(f"{line}\n"),
        ):
            sys.stdout.write(json.dumps(row) + "\n")
            sys.stdout.flush()
    except (CheckpointError, ValueError, OSError, ImportError) as error:
        sys.stderr.write(f"pixelbrax evaluate: {error}\n")
        return 1
    return 0
