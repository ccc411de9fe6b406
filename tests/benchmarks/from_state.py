"""What Brax's own PPO learns from the state in the environments of docs/results.md.

    python -m tests.benchmarks.from_state                     the four tasks
    python -m tests.benchmarks.from_state --tasks walker2d --reward-preset brax

It tells a hard task from an agent that does not see: same physics, rewards, action repeat,
discount, environments, rollouts and number of steps, Brax's networks and Adam's usual step size.
"""

from __future__ import annotations

import argparse
import json
import time

from brax.training.agents.ppo import train as ppo

from pixelbrax_jax import BraxEnv, make, wrap_fresh_episodes
from pixelbrax_jax.agents.config import TrainConfig, describe
from pixelbrax_jax.agents.presets import preset
from pixelbrax_jax.physics.brax.tasks import REWARD_PRESETS
from tests.benchmarks.experiments import TASKS
from tests.benchmarks.results import FOLDER, task_key

OUTPUT = FOLDER / "from_state.json"


def keep(config: TrainConfig) -> None:
    """Train, and keep the curve: mean returns of 128 episodes with the mean action.

    What is known of it is written with every evaluation.
    """
    env = BraxEnv(*make(config.env, obs_mode="state"))
    found: dict = {"steps": [], "seconds": [], "return": [], "length": []}
    began = time.monotonic()

    def progress(calls: int, metrics: dict) -> None:
        found["steps"].append(calls * config.env.action_repeat)
        found["seconds"].append(round(time.monotonic() - began, 1))
        found["return"].append(round(float(metrics["eval/episode_reward"]), 1))
        found["length"].append(float(metrics["eval/avg_episode_length"]) * config.env.action_repeat)
        print(config.env.task, found["steps"][-1], found["return"][-1], flush=True)
        known = json.loads(OUTPUT.read_text()) if OUTPUT.exists() else {}
        OUTPUT.write_text(json.dumps(known | {task_key(describe(config)): found}) + "\n")

    ppo.train(
        env,
        num_timesteps=config.total_steps // config.env.action_repeat,
        episode_length=env.episode_length,
        wrap_env_fn=wrap_fresh_episodes,
        num_envs=config.num_envs,
        unroll_length=config.num_steps,
        num_minibatches=config.num_minibatches,
        batch_size=config.num_envs // config.num_minibatches,
        num_updates_per_batch=4,
        learning_rate=3e-4,
        entropy_cost=1e-3,
        discounting=config.gamma,
        gae_lambda=config.gae_lambda,
        normalize_observations=True,
        num_evals=10,
        deterministic_eval=True,
        progress_fn=progress,
    )


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--reward-preset", choices=REWARD_PRESETS, help="in place of the preset's")
    options = parser.parse_args()
    for task in options.tasks:
        config = preset("ppo", "cpu", task)
        reward = options.reward_preset or config.env.reward_preset
        keep(config.replace(reward_preset=reward))


if __name__ == "__main__":
    main()
