"""What pretrained policies earn where they were not trained, for docs/results.md.

python -m tests.benchmarks.elsewhere        a minute
"""

from __future__ import annotations

import argparse
import json

from pixelbrax_jax.agents.runner.evaluate import Evaluator
from pixelbrax_jax.agents.runner.splits import make_split
from pixelbrax_jax.agents.runner.trained import load_pretrained
from pixelbrax_jax.policy import read_pretrained
from tests.benchmarks.experiments import EPISODES
from tests.benchmarks.results import FOLDER

KEPT = FOLDER / "elsewhere.json"
VIDEO = {"distractors": ("paper-video",), "clips": "procedural"}
CASES = {
    "walker2d by Brax's reward": ("walker2d", "clean", {"reward_preset": "brax"}),
    "halfcheetah under paper-video": ("halfcheetah", "test", VIDEO),
    "halfcheetah under paper-color": ("halfcheetah", "train", {"distractors": ("paper-color",)}),
}
"""Name -> policy, split and changed settings."""


def identity(task: str) -> dict:
    """What tells one pretrained policy of a task from another."""
    about = read_pretrained(task)
    return {name: about[name] for name in ("command", "return")}


def play(task: str, split: str, changes: dict) -> dict:
    """Play the episodes of an evaluation."""
    agent = load_pretrained(task)
    environment = make_split(agent.algorithm.config.replace(**changes), split)
    result = Evaluator(agent.algorithm, *environment, num_episodes=EPISODES)(agent.networks)
    return {
        "policy": identity(task),
        "episodes": EPISODES,
        "return": result.mean,
        "standard_error": result.standard_error,
        "length": float(result.lengths.mean()),
    }


def main() -> None:
    """Play where it is not known of the policy of today."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    known = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    for name, (task, split, changes) in CASES.items():
        if known.get(name, {}).get("policy") != identity(task):
            known[name] = play(task, split, changes)
    KEPT.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
