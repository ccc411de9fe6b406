"""Times a suite of levels, and dm_control with the same policy.

MUJOCO_GL=egl python -m tests.benchmarks.generalisation_minutes    six minutes, on an idle machine
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pixelbrax_gym.generalisation.scores import RETURNS, Scores
from pixelbrax_jax.agents.runner.splits import make_split
from pixelbrax_jax.agents.runner.trained import load_pretrained
from pixelbrax_jax.agents.runner.transfer import play_in
from pixelbrax_jax.physics.dmc.suite import SuiteEnv
from pixelbrax_jax.processor import describe_cpu
from tests.benchmarks.generalisation import KEPT
from tests.benchmarks.performance import read

POLICY = "dmc_walker_walk"
SUITE = "dmcgb2"
TIMED = 4
"""Episodes in dm_control, after one that compiles the policy."""
MINUTES = KEPT / "minutes.json"


def here() -> tuple[int, float]:
    """Number of episodes of the suite, and the seconds of the command that plays them."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pixelbrax_gym.cli", "--keep-no-programs", "evaluate"]
        command += ["--pretrained", POLICY, "--suite", SUITE, "--clips", "procedural"]
        began = time.perf_counter()
        subprocess.run([*command, "--output-dir", folder], check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - began
        found = Scores(**json.loads((Path(folder) / RETURNS).read_text("utf-8")))
    return sum(len(row) for levels in found.returns.values() for row in levels.values()), seconds


def in_dm_control() -> float:
    """Seconds of an episode in one process, without distractors."""
    agent = load_pretrained(POLICY)
    config = agent.algorithm.config
    size = config.env.height, config.env.width
    clean, params = make_split(config, "clean")

    def play(simulator: SuiteEnv, episodes: int) -> float:
        began = time.perf_counter()
        play_in(simulator, agent.algorithm, agent.networks, clean, params, num_episodes=episodes)
        return time.perf_counter() - began

    made = SuiteEnv(config.env.task, size=size, samples=config.env.samples)
    with closing(made) as simulator:
        play(simulator, 1)
        return play(simulator, TIMED) / TIMED


def main() -> None:
    """Time both, one after the other."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    episodes, seconds = here()
    kept = {
        "policy": POLICY,
        "suite": SUITE,
        "episodes": episodes,
        "seconds": seconds,
        "seconds_of_an_episode_in_dm_control": in_dm_control(),
        "machine": describe_cpu(),
        "versions": {name: version(name) for name in ("jax", "pixelbrax", "dm_control", "mujoco")},
    }
    MINUTES.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")


def minutes() -> str:
    """Minutes of the suite here."""
    return f"{_read()['seconds'] / 60:.1f}"


def hours() -> str:
    """Hours of as many episodes in dm_control."""
    kept = _read()
    return f"{kept['episodes'] * kept['seconds_of_an_episode_in_dm_control'] / 3600:.1f}"


def where() -> str:
    """The cores that both had."""
    machine = _read()["machine"]
    return f"{machine['cores']} cores with {machine['vectors']}"


def _read() -> dict[str, Any]:
    found: dict[str, Any] = read("benchmarks/generalisation/minutes.json")
    return found


FIGURES = {
    "minutes": minutes,
    "hours": hours,
    "episodes": lambda: f"{_read()['episodes']:,}",
    "where": where,
    "timed": lambda: str(TIMED),
    "episode-seconds": lambda: f"{_read()['seconds_of_an_episode_in_dm_control']:.1f}",
}


if __name__ == "__main__":
    main()
