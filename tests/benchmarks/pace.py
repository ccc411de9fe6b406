"""How fast the presets of docs/results.md train where nothing else computes, as JSON.

    python -m tests.benchmarks.pace        twenty minutes

The runs themselves are made in the background of other work; their minutes are computed with this.
Each preset is measured twice, in turns, and the faster time is kept.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from operator import itemgetter
from pathlib import Path

from pixelbrax_jax.agents.presets import preset
from pixelbrax_jax.agents.runner.metrics import read_metrics
from pixelbrax_jax.processor import describe_cpu
from tests.benchmarks.experiments import ALGORITHMS, TASKS
from tests.benchmarks.results import FOLDER

KEPT = FOLDER / "pace.json"
ITERATIONS = 64
ROUNDS = 2


def measure(algorithm: str, task: str) -> dict[str, float]:
    """Train for some iterations.

    Returns:
        Control steps and seconds from the start of training to the end of the first auxiliary
        phase, or iteration where there is none, when everything is compiled, and seconds of a
        control step afterwards, over whole phases.
    """
    config = preset(algorithm, "cpu", task)
    steps = ITERATIONS * config.num_envs * config.num_steps * config.env.action_repeat
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pixelbrax_gym.cli", "train", algorithm, "--task", task]
        command += ["--preset", "cpu", "--total-steps", str(steps), "--num-evals", "0"]
        command += ["--no-progress", "--output-dir", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        records = read_metrics(Path(folder) / "metrics.jsonl")
    first, last = records[getattr(config, "num_policy_phases", 1) - 1], records[-1]
    step = (last["seconds"] - first["seconds"]) / (last["steps"] - first["steps"])
    return {"first_steps": first["steps"], "first_seconds": first["seconds"], "step": step}


def main() -> None:
    """Measure all of them."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    presets: dict[str, dict[str, float]] = {}
    for task in ROUNDS * TASKS:
        for algorithm in ALGORITHMS:
            name, found = f"{algorithm}-{task}", measure(algorithm, task)
            presets[name] = min(presets.get(name, found), found, key=itemgetter("step"))
    KEPT.write_text(json.dumps({"machine": describe_cpu(), "presets": presets}, indent=1) + "\n")


if __name__ == "__main__":
    main()
