"""Trains the agents of docs/results.md, one run after the other, at the lowest priority.

    python -m tests.benchmarks.experiments                         what is missing; hours
    python -m tests.benchmarks.experiments --only ppo-walker2d     those with this in their names
    python -m tests.benchmarks.experiments --minutes 90            stops in time
    python -m tests.benchmarks.experiments --list                  the commands
    python -m tests.benchmarks.experiments --gpu                   those for a GPU in place of them

A run that was cut short, by Ctrl-C or by --minutes, goes on from its checkpoint at the next call.
Of a finished one docs/results/runs/<name>.json is kept; of DrQ-v2, or a task that is not Brax's, an
entry of docs/leaderboard. `tests.benchmarks.figures` draws all of them, and those of
docs/results with the minutes that follow from the speed that `tests.benchmarks.pace` measures.
The best policy of each task goes into the package, for --pretrained.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import pixelbrax_jax
from pixelbrax_gym.cli import _leaderboard as leaderboard
from pixelbrax_gym.cli.train import parse
from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.presets import TASK_SETTINGS, preset
from pixelbrax_jax.agents.runner.checkpoint import read_about
from pixelbrax_jax.agents.runner.metrics import read_metrics
from pixelbrax_jax.agents.runner.trained import load_config
from pixelbrax_jax.processor import describe_cpu
from pixelbrax_jax.stop_signals import handling
from pixelbrax_jax.tasks import BRAX_TASKS

DOCS = Path(__file__).parents[2] / "docs"
KEPT = DOCS / "results" / "runs"
LEADERBOARD = DOCS / "leaderboard"
PRETRAINED = Path(pixelbrax_jax.__file__).parent / "pretrained"
EPISODES = 32
ALGORITHMS = ("ppo", "ppg", "dcpg")
TASKS = ("halfcheetah", "walker2d", "ant", "humanoid")
TIMED = (
    "dmc_cartpole_swingup",
    "dmc_walker_walk",
    "dmc_cheetah_run",
    "dmc_finger_spin",
    "dmc_ball_in_cup_catch",
    "dmc_reacher_easy",
    "dmc_hopper_stand",
    "dmc_walker_stand",
    "dmc_pendulum_swingup",
    "dmc_cartpole_balance_sparse",
    *TASKS,
)
"""Tasks of the leaderboard."""
DISTRACTED = {
    "halfcheetah": ("video", "color"),
    "walker2d": ("video", "color"),
    "ant": ("video",),
    "humanoid": ("video",),
}
DISTRACTORS = {
    "video": ("--distractors", "paper-video", "--clips", "procedural"),
    "color": ("--distractors", "paper-color"),
}
REVISION = 2
"""Raised when the same settings train something else. 1: the encoder `patch` saw pixels in
[0, 1]; 2: it sees them in [-0.5, 0.5]."""
GPU_STEPS = {
    "halfcheetah": 25_000_000,
    "walker2d": 25_000_000,
    "ant": 25_000_000,
    "humanoid": 50_000_000,
}


def experiments() -> dict[str, list[str]]:
    """Arguments of ``pixelbrax`` for each run, by name, in the order in which they are made."""
    runs = {}

    def add(algorithm: str, task: str, seed: int, *more: str, name: str = "") -> None:
        full = "-".join([algorithm, task, *([name] if name else []), str(seed)])
        command = ["train", algorithm, "--preset", "cpu", "--task", task, "--seed", str(seed)]
        runs[full] = [*command, "--eval-episodes", str(EPISODES), *more]

    def longer(task: str, times: int, *more: str, name: str) -> None:
        steps = times * preset("ppo", "cpu", task).total_steps
        more = ("--total-steps", str(steps), "--num-evals", str(3 * times), *more)
        add("ppo", task, 0, *more, name=name)

    for seed in range(3):
        for task in TASKS:
            for algorithm in ALGORITHMS:
                add(algorithm, task, seed, "--num-evals", "3")
    for task in TASKS:
        longer(task, 4, name="long")
    for times, name in ((4, "long-slow"), (8, "longest-slow")):
        longer("halfcheetah", times, "--learning-rate", "3e-4", name=name)
    for seed in range(2):
        for task, names in DISTRACTED.items():
            for name in names:
                for algorithm in ALGORITHMS:
                    more = (*DISTRACTORS[name], "--num-evals", "1")
                    add(algorithm, task, seed, *more, name=name)
    for seed in range(2):
        for algorithm in ALGORITHMS:
            more = ("--reward-preset", "brax", "--num-evals", "3")
            add(algorithm, "walker2d", seed, *more, name="brax")
    for seed in range(3):
        for task in TIMED:
            add("drqv2", task, seed, "--num-evals", "16")
    for seed in range(3):
        for task in TASK_SETTINGS["cpu"]["ppo"]:
            if task not in BRAX_TASKS:
                add("ppo", task, seed, "--num-evals", "16")
    return runs


def on_leaderboard(algorithm: str, task: str) -> bool:
    """Whether a run is kept as an entry of the leaderboard."""
    return algorithm == "drqv2" or task not in BRAX_TASKS


def kept_at(name: str) -> Path:
    """The file that keeps a run."""
    return (LEADERBOARD if on_leaderboard(*name.split("-")[:2]) else KEPT) / f"{name}.json"


def gpu_experiments() -> dict[str, list[str]]:
    """The same for a GPU: the paper's tasks and numbers of steps, with a video as background.

    Walker2d's reward is the paper's, as in the preset ``cpu``. Tables show these runs not yet.

    Many environments keep a GPU busy; a rollout's frames take 1.4 GB, PPG's buffer 23 GB. PPG and
    DCPG leave about 50 GB of checkpoints each, for their buffer belongs to a checkpoint.
    """
    size = "--num-envs 1024 --num-steps 64 --num-minibatches 16 --num-evals 10 --eval-episodes 64"
    return {
        f"{algorithm}-{task}-gpu-{seed}": [
            *("train", algorithm, "--task", task, "--total-steps", str(steps), *size.split()),
            *("--distractors", "video", "--clips", "procedural", "--seed", str(seed)),
            *(("--reward-preset", "paper") if task == "walker2d" else ()),
            *("--checkpoint-every", str(steps // 10), "--keep-checkpoints", "1"),
        ]
        for seed in range(5)
        for task, steps in GPU_STEPS.items()
        for algorithm in ALGORITHMS
    }


def record(folder: Path, arguments: list[str]) -> dict:
    """What is kept of a finished run: settings, returns over steps and time, evaluations."""
    about = read_about(folder / "checkpoints")
    command = {"command": shlex.join(["pixelbrax", *arguments]), "revision": REVISION}
    if on_leaderboard(about["algorithm"], about["config"]["task"]):
        return command | leaderboard.entry(folder)
    records = read_metrics(folder / "metrics.jsonl")
    training = [r for r in records if "episode/return" in r]
    evaluations = [
        {"steps": r["steps"], "seconds": r["seconds"]}
        | {name.removeprefix("eval/"): x for name, x in r.items() if name.startswith("eval/")}
        for r in records
        if "eval/clean/return" in r
    ]
    packages = ("jax", "jaxlib", "brax", "pixelbrax")
    return command | {
        "algorithm": about["algorithm"],
        "config": about["config"],
        "machine": describe_cpu(),
        "versions": {name: version(name) for name in packages},
        "steps": [r["steps"] for r in training],
        "seconds": [round(r["seconds"], 1) for r in training],
        "episodes": [int(r["episode/count"]) for r in training],
        "return": [round(r["episode/return"], 2) for r in training],
        "evaluations": evaluations,
    }


def offer(task: str, folder: Path, kept: dict) -> None:
    """Put a finished run's policy into the package if it is the best of its task so far.

    Returns by other rewards, or from other images, compare with none of the preset's.
    """
    about = PRETRAINED / f"{task}.json"
    if "evaluations" in kept:
        last = kept["evaluations"][-1]
    else:
        names = {"clean/return": "return", "clean/standard_error": "standard_error"}
        last = {name: kept[key][-1] for name, key in (names | {"steps": "frames"}).items()}
    env = preset(kept["algorithm"], "cpu", task).env
    wanted = {name: getattr(env, name) for name in ("reward_preset", "look", "samples")}
    if not wanted.items() <= kept["config"].items():
        return
    before = json.loads(about.read_text()) if about.exists() else None
    comparable = before and wanted.items() <= before["config"].items()
    if comparable and last["clean/return"] <= before["return"]:
        return
    PRETRAINED.mkdir(exist_ok=True)
    shutil.copyfile(folder / "policy.jax", PRETRAINED / f"{task}.jax")
    names = ["task", "backend", "reward_preset"]
    names += ["height", "width", "samples", "frame_stack", "action_repeat", "look"]
    written = {
        "return": last["clean/return"],
        "standard_error": last["clean/standard_error"],
        "episodes": EPISODES,
        "steps": last["steps"],
        "env_options": {name: kept["config"][name] for name in names},
    }
    written |= {name: kept[name] for name in ("algorithm", "command", "versions", "config")}
    about.write_text(json.dumps(written, indent=1) + "\n")


def run(arguments: list[str], folder: Path, until: float) -> int:
    """Make a run, or go on with it; its exit status, above 128 if it was stopped."""
    command = [sys.executable, "-m", "pixelbrax_gym.cli", *arguments]
    command += ["--resume", "latest", "--output-dir", str(folder)]
    nice = subprocess.Popen(["nice", "-n", "19", *command], start_new_session=True)
    with nice as process, handling(lambda *_: process.terminate()):
        try:
            # None would be no limit, and infinity is an error.
            return process.wait(min(1e6, max(0.0, until - time.monotonic())))
        except subprocess.TimeoutExpired:
            process.terminate()
            return process.wait() or 128 + signal.SIGTERM


def config_of(arguments: list[str]) -> TrainConfig:
    """The settings that a command gives."""
    _, algorithm, *line = arguments
    return parse(algorithm, line)[1]


def is_made(path: Path, arguments: list[str]) -> bool:
    """Whether a run is kept, and of what its command trains today."""
    if not path.exists():
        return False
    kept, wanted = json.loads(path.read_text()), config_of(arguments)
    # All renderers draw the same.
    config = load_config(kept).replace(renderer=wanted.env.renderer)
    return kept["revision"] == REVISION and config == wanted


def main() -> int:
    """Run the command; the exit status is 1 if a run failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="part of the names of runs")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="then stop")
    parser.add_argument("--output-dir", type=Path, default=Path("runs/results"))
    parser.add_argument("--gpu", action="store_true", help="runs of the paper's size")
    parser.add_argument("--list", action="store_true", help="only write the commands")
    options = parser.parse_args()
    runs = gpu_experiments() if options.gpu else experiments()
    chosen = {name: line for name, line in runs.items() if options.only in name}
    if not chosen:
        parser.error(f"no run has {options.only!r} in its name; --list shows all")
    until, failed = time.monotonic() + 60.0 * options.minutes, []
    for name, arguments in chosen.items():
        path = kept_at(name)
        made = is_made(path, arguments)
        # Checkpoints of another revision would go on as if they were of this one.
        folder = options.output_dir / f"revision-{REVISION}" / name
        if options.list:
            print(f"{name:24s} {'done' if made else '    '} {shlex.join(arguments)}")
        if options.list or made:
            continue
        status = run(arguments, folder, until)
        if status > 128 or status < 0:
            print(f"stopped in {name}; the same command goes on", file=sys.stderr)
            break
        if status:
            failed.append(name)
            continue
        kept = record(folder, arguments)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(kept) + "\n")
        # DrQ-v2 has other rewards on Brax's tasks.
        own = kept["algorithm"] != "drqv2" or kept["config"]["task"] not in BRAX_TASKS
        if own and not kept["config"]["distractors"]:
            offer(kept["config"]["task"], folder, kept)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
