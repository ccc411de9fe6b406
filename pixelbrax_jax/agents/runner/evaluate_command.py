"""``pixelbrax evaluate``: returns of a trained agent."""

from __future__ import annotations

import argparse
import json
import sys

from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
from pixelbrax_jax.agents.runner.evaluate import Evaluator, NoSplitError, make_split, splits_of
from pixelbrax_jax.agents.runner.settings import place_of
from pixelbrax_jax.agents.runner.trained import load_chosen, with_clips
from pixelbrax_jax.validation import check_positive_int


def evaluate(options: argparse.Namespace) -> int:
    """Run the command; see ``pixelbrax evaluate --help``.

    Returns:
        The exit status.
    """
    try:
        check_positive_int("episodes", options.episodes)
        agent = load_chosen(options)
        config, shown = with_clips(agent, options.clips)
        if options.clips and not shown:
            sys.stderr.write(
                "pixelbrax evaluate: the run has no digest of its clips; those of "
                f"{options.clips} are taken for them\n"
            )
        for name in options.split or splits_of(config):
            try:
                env, params = make_split(config, name, shown)
            except NoSplitError as error:
                if options.split:
                    raise
                sys.stderr.write(f"pixelbrax evaluate: no split {name!r}: {error}\n")
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
    except (CheckpointError, ValueError, OSError, ImportError) as error:
        sys.stderr.write(f"pixelbrax evaluate: {error}\n")
        return 1
    return 0
