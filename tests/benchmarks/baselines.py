"""What random actions, and none, earn.

    python -m tests.benchmarks.baselines     MuJoCo's tasks, where it is not known; an hour

`tests.benchmarks.figures` adds the tasks of docs/results.md.
"""

from __future__ import annotations

import argparse
import json
from functools import partial

import jax
import numpy as np

from pixelbrax_jax import VectorPixelEnv, compiler_options, make
from pixelbrax_jax.physics.dmc.tasks import TASKS as DMC_TASKS
from pixelbrax_jax.physics.gym.tasks import TASKS as GYM_TASKS
from tests.benchmarks.results import FOLDER

KEPT = FOLDER / "untrained.json"
SETTINGS = ("task", "backend", "reward_preset", "action_repeat", "episode_length")
"""Settings that decide what a return means."""


def untrained(settings: dict, episodes: int = 256) -> dict:
    """Returns of whole episodes under uniform actions in [-1, 1], and under none (0)."""
    env, params = make(obs_mode="state", **settings)
    envs = VectorPixelEnv(env, episodes, "disabled")
    steps = -(-settings["episode_length"] // env.action_repeat)

    @partial(jax.jit, compiler_options=compiler_options(env))
    def play(key, params, scale):
        def step(state, key):
            action = scale * jax.random.uniform(key, (episodes, env.action_size), minval=-1.0)
            state, timestep = envs.step(state, action, params)
            over = timestep.terminated | timestep.truncated
            return state, (timestep.info["episode_return"], over)

        first, rest = jax.random.split(key)
        state, _ = envs.reset(first, params)
        _, (returns, over) = jax.lax.scan(step, state, jax.random.split(rest, steps))
        return returns[over.argmax(0), np.arange(episodes)]

    result = {"settings": settings, "episodes": episodes}
    for name, scale in (("random", 1.0), ("none", 0.0)):
        returns = np.asarray(play(jax.random.key(0), params, scale))
        error = float(returns.std(ddof=1) / np.sqrt(episodes))
        result[name] = {"return": float(returns.mean()), "standard_error": error}
    return result


def play_baselines(configs: dict[str, dict], episodes: int = 256) -> None:
    """Play where it is not known yet; each result is kept at once."""
    known = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    for name, config in configs.items():
        settings = {setting: config[setting] for setting in SETTINGS if setting in config}
        if known.get(name, {}).get("settings") != settings:
            known[name] = untrained(settings, episodes)
            KEPT.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    play_baselines(
        {
            task: {"task": task, "action_repeat": 1, "episode_length": 1000}
            for task in (*DMC_TASKS, *GYM_TASKS)
        },
        episodes=64,
    )
