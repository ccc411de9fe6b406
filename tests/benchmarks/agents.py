"""Learning curves of training runs, as JSON and a plot.

    python -m tests.benchmarks.agents --output docs/benchmarks/agents runs/ppo runs/ppg runs/dcpg

Each folder is the output of one ``pixelbrax train``. Curves are means of the returns of episodes
that ended in training; nothing is smoothed.
"""

from __future__ import annotations

import argparse
import json
import platform
from importlib.metadata import version
from pathlib import Path

from pixelbrax_jax.agents.checkpoint import read_about
from pixelbrax_jax.agents.metrics import read_metrics


def curve_of(folder: Path) -> dict:
    """Returns over steps of one run, and its last evaluation."""
    about = read_about(folder / "checkpoints")
    records = read_metrics(folder / "metrics.jsonl")
    training = [r for r in records if "episode/return" in r]
    evaluation = {k: v for r in records for k, v in r.items() if k.startswith("eval/")}
    # The first record's time includes compilation.
    first, last = training[0], training[-1]
    speed = (last["steps"] - first["steps"]) / (last["seconds"] - first["seconds"])
    return {
        "algorithm": about["algorithm"],
        "config": about["config"],
        "steps": [r["steps"] for r in training],
        "return": [round(r["episode/return"], 2) for r in training],
        "seconds": last["seconds"],
        "steps_per_second": round(speed),
        "evaluation": evaluation,
    }


def plot(curves: list[dict], path: Path) -> None:
    """Return over steps, a line for each run."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for curve in curves:
        config = curve["config"]
        behind = "".join(f", {name}" for name in config["distractors"])
        label = f"{curve['algorithm'].upper()}, {config['task']}{behind}, seed {config['seed']}"
        axes.plot([s / 1e6 for s in curve["steps"]], curve["return"], label=label)
    axes.set(xlabel="million control steps", ylabel="return of training episodes")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="without .json or .png")
    options = parser.parse_args()
    curves = [curve_of(folder) for folder in options.runs]
    about = {"jax": version("jax"), "brax": version("brax"), "machine": platform.machine()}
    options.output.with_suffix(".json").write_text(json.dumps({"about": about, "runs": curves}))
    plot(curves, options.output.with_suffix(".png"))
    for curve in curves:
        print(curve["algorithm"], curve["steps_per_second"], "steps/s", curve["evaluation"])


if __name__ == "__main__":
    main()
