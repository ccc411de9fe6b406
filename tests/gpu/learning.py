"""The learning runs of the paper's second half, for a machine with a GPU.

    python -m tests.gpu.learning --list                       what there is to run
    python -m tests.gpu.learning --seeds 5                    all of it, one run after the other
    python -m tests.gpu.learning --only ppo/halfcheetah/0     a part

HalfCheetah, Walker2d and Ant for 25 million control steps, Humanoid for 50 million, with the video
distractor in the background, PPO, PPG and DCPG. A run that was stopped goes on; one that is done
ends at once; one that fails is told, and the rest goes on. Afterwards `tests.benchmarks.agents`
draws the curves of the folders. PPG and DCPG leave about 50 GB of checkpoints each, for their
buffer belongs to a checkpoint: what is no longer needed, delete.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import subprocess
import sys
from pathlib import Path

SIGNALLED = 128
"""A run that was stopped exits with this and the signal's number."""

STEPS = {
    "halfcheetah": 25_000_000,
    "walker2d": 25_000_000,
    "ant": 25_000_000,
    "humanoid": 50_000_000,
}
ALGORITHMS = ("ppo", "ppg", "dcpg")

# Many environments keep a GPU busy; the rollout of frames takes 1.4 GB, PPG's buffer 23 GB.
SIZE = "--num-envs 1024 --num-steps 64 --num-minibatches 16"


def commands(seeds: int, folder: Path, clips: str) -> dict[str, list[str]]:
    """The command of each run, by ``algorithm/task/seed``.

    Args:
        seeds: how many, each in a program of its own: five buffers would not fit.
        folder: of the outputs.
        clips: of the video distractor.
    """
    return {
        f"{algorithm}/{task}/{seed}": [
            *("train", algorithm, "--task", task, "--total-steps", str(steps)),
            *("--distractors", "video", "--clips", clips, *SIZE.split()),
            *("--seed", str(seed), "--num-evals", "10", "--eval-episodes", "64"),
            *("--checkpoint-every", str(steps // 10), "--keep-checkpoints", "1"),
            *("--resume", "latest", "--output-dir", str(folder / algorithm / task / str(seed))),
        ]
        for seed in range(seeds)
        for algorithm in ALGORITHMS
        for task, steps in STEPS.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="only print the commands")
    parser.add_argument("--only", nargs="+", default=[], help="such as ppo/ant/0")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--clips", default="procedural", help="or DAVIS-2017's folder")
    parser.add_argument("--output-dir", type=Path, default=Path("runs/gpu"))
    options = parser.parse_args()
    wanted = commands(options.seeds, options.output_dir, options.clips)
    if unknown := set(options.only) - set(wanted):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(wanted)}")
    # A terminal sends Ctrl-C to both; the run writes a checkpoint, and is waited for.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    for name, line in wanted.items():
        if options.only and name not in options.only:
            continue
        if options.list:
            sys.stdout.write(f"pixelbrax {shlex.join(line)}\n")
            continue
        status = subprocess.Popen([sys.executable, "-m", "pixelbrax_jax.cli", *line]).wait()
        if status > SIGNALLED:
            sys.exit(status)
        if status:
            sys.stderr.write(f"{name} failed with status {status}\n")


if __name__ == "__main__":
    main()
