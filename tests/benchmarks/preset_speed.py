"""Steps per second of training with each preset `cpu`, as JSON: the clock of docs/results.md.

    python -m tests.benchmarks.preset_speed

The runs of that page were made in the background of other work, and on several machines. What
they reach after some minutes is read at the steps that these speeds give, so nothing else may
compute meanwhile. Ten minutes on two cores.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from pixelbrax_gym.bench.machine import describe_cpu
from pixelbrax_jax.agents.algorithms.presets import preset
from pixelbrax_jax.agents.algorithms.registry import ALGORITHMS
from pixelbrax_jax.agents.runner.metrics import read_metrics
from tests.benchmarks.experiments import TASKS

KEPT = Path(__file__).parents[2] / "docs" / "results" / "speed.json"
ITERATIONS = 32


def measure(algorithm: str, task: str) -> dict[str, float]:
    """Seconds to the end of the first iteration, and steps per second from then on."""
    steps = ITERATIONS * preset(algorithm, "cpu", task).steps_per_iteration
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pixelbrax_jax.cli", "train", algorithm]
        command += ["--preset", "cpu", "--task", task, "--output-dir", f"{folder}/run"]
        command += ["--total-steps", str(steps), "--num-evals", "0"]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        records = read_metrics(Path(folder, "run", "metrics.jsonl"))
    first, last = records[0], records[-1]
    speed = (last["steps"] - first["steps"]) / (last["seconds"] - first["seconds"])
    return {"seconds_of_first_iteration": first["seconds"], "steps_per_second": round(speed, 1)}


def main() -> None:
    """Measure all of them, one after the other."""
    packages = ("jax", "jaxlib", "brax", "pixelbrax")
    pairs = {f"{a}-{task}": measure(a, task) for task in TASKS for a in ALGORITHMS}
    kept = {
        "command": "python -m tests.benchmarks.preset_speed",
        "machine": describe_cpu(),
        "versions": {name: version(name) for name in packages},
        "pairs": pairs,
    }
    KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    print(json.dumps(pairs, indent=1))


if __name__ == "__main__":
    main()
