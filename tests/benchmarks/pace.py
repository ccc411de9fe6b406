"""How fast the presets of docs/results.md train where nothing else computes, as JSON.

    python -m tests.benchmarks.pace        ten minutes

The runs themselves are made in the background of other work; their minutes are computed with this.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from pixelbrax_gym.bench.machine import describe_cpu
from pixelbrax_jax.agents.algorithms.presets import preset
from pixelbrax_jax.agents.algorithms.registry import ALGORITHMS
from pixelbrax_jax.agents.runner.metrics import read_metrics
from tests.benchmarks.experiments import DOCS, TASKS

KEPT = DOCS / "results" / "pace.json"
ITERATIONS = 32


def measure(algorithm: str, task: str) -> dict[str, float]:
    """Train for some iterations.

    Returns:
        Seconds from the start of training to the end of the first iteration, and seconds of a
        control step afterwards.
    """
    config = preset(algorithm, "cpu", task)
    steps = ITERATIONS * config.num_envs * config.num_steps * config.action_repeat
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pixelbrax_jax.cli", "train", algorithm, "--task", task]
        command += ["--preset", "cpu", "--total-steps", str(steps), "--num-evals", "0"]
        command += ["--no-progress", "--output-dir", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        first, *_, last = read_metrics(Path(folder) / "metrics.jsonl")
    step = (last["seconds"] - first["seconds"]) / (last["steps"] - first["steps"])
    return {"first_iteration": first["seconds"], "step": step}


def main() -> None:
    """Measure all of them."""
    presets = {}
    for task in TASKS:
        for algorithm in ALGORITHMS:
            presets[f"{algorithm}-{task}"] = measure(algorithm, task)
    KEPT.write_text(json.dumps({"machine": describe_cpu(), "presets": presets}, indent=1) + "\n")


if __name__ == "__main__":
    main()
