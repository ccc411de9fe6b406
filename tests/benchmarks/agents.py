"""Learning curves of training runs, as JSON and a plot.

    python -m tests.benchmarks.agents --output docs/benchmarks/agents runs/ppo runs/ppg runs/dcpg

Each argument is the output folder of one ``pixelbrax train``, or the JSON of an earlier call, whose
runs are kept. Curves are means of the returns of episodes that ended in training; nothing is
smoothed. What drawn actions reach in the same tasks stands beside them.
"""

from __future__ import annotations

import argparse
import json
import platform
from importlib.metadata import version
from pathlib import Path

import numpy as np

from pixelbrax_jax.agents.runner.checkpoint import read_about
from pixelbrax_jax.agents.runner.metrics import read_metrics
from tests.benchmarks.results import TASK_SETTINGS, untrained


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


def name_of(curve: dict) -> str:
    """What all seeds of an experiment share."""
    config = curve["config"]
    behind = "".join(f", {name}" for name in config["distractors"])
    return f"{curve['algorithm'].upper()}, {config['task']}{behind}"


def plot(curves: list[dict], drawn: dict[str, dict], path: Path) -> None:
    """Return over steps: a thin line for each run, a thick one for the mean over seeds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(curve["config"]["task"] for curve in curves))
    figure, panels = plt.subplots(
        1, len(tasks), figsize=(6 * len(tasks), 4), layout="constrained", squeeze=False
    )
    names = list(dict.fromkeys(map(name_of, curves)))
    for task, axes in zip(tasks, panels[0], strict=True):
        for number, name in enumerate(names):
            runs = [c for c in curves if name_of(c) == name and c["config"]["task"] == task]
            if not runs:
                continue
            for run in runs:
                steps = np.divide(run["steps"], 1e6)
                axes.plot(steps, run["return"], color=f"C{number}", alpha=0.35, linewidth=0.8)
            common = np.linspace(
                max(run["steps"][0] for run in runs), min(run["steps"][-1] for run in runs), 60
            )
            mean = np.mean([np.interp(common, run["steps"], run["return"]) for run in runs], axis=0)
            count = f"{len(runs)} seeds" if len(runs) > 1 else "1 seed"
            axes.plot(common / 1e6, mean, color=f"C{number}", label=f"{name}, {count}")
        axes.axhline(drawn[task]["return"], color="gray", linestyle=":", label="random policy")
        axes.set(xlabel="million control steps", ylabel="return of training episodes", title=task)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)


def runs_of(path: Path) -> list[dict]:
    """The run of a folder, or those of an earlier call's JSON."""
    return json.loads(path.read_text())["runs"] if path.suffix == ".json" else [curve_of(path)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="without .json or .png")
    options = parser.parse_args()
    curves = [curve for path in options.runs for curve in runs_of(path)]
    kinds = {tuple(curve["config"][name] for name in TASK_SETTINGS) for curve in curves}
    tasks = [dict(zip(TASK_SETTINGS, kind, strict=True)) for kind in kinds]
    drawn = {settings["task"]: untrained(settings)["drawn"] for settings in tasks}
    if len(drawn) < len(tasks):
        names = ", ".join(TASK_SETTINGS[1:])
        raise SystemExit(f"runs of one task differ in {names}; plot them apart")
    about = {"jax": version("jax"), "brax": version("brax"), "machine": platform.machine()}
    options.output.with_suffix(".json").write_text(
        json.dumps({"about": about, "drawn_actions": drawn, "runs": curves})
    )
    plot(curves, drawn, options.output.with_suffix(".png"))
    for curve in curves:
        speed = f"{curve['steps_per_second']} steps/s"
        print(name_of(curve), "seed", curve["config"]["seed"], speed, curve["evaluation"])
    print("drawn actions", drawn)


if __name__ == "__main__":
    main()
