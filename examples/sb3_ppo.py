"""Stable-Baselines3's PPO balances an inverted pendulum from pixels.

    python examples/sb3_ppo.py

Everything but the environment is Stable-Baselines3's own. Its networks take NumPy arrays, so
frames are copied to wherever PyTorch works; on a CPU they stay where JAX put them.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

# JAX and PyTorch take turns on the same cores; see docs/troubleshooting.md.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from pixelbrax_gym import SB3VecEnv


def make_env(num_envs: int, seed: int, *, stagger: bool = False) -> VecMonitor:
    """Pixel environments that report the returns of their episodes."""
    env = SB3VecEnv(
        "inverted_pendulum",
        num_envs,
        height=36,
        width=36,
        frame_stack=2,
        channels_first=True,
        stagger=stagger,
    )
    env.seed(seed)
    return VecMonitor(env)


def main(arguments: list[str] | None = None) -> dict:
    """Trains and evaluates; returns the figures that it prints."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--total-steps", type=int, default=800_000)
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--eval-episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output-dir", type=Path, default=Path("runs/sb3_ppo"))
    options = parser.parse_args(arguments)
    options.output_dir.mkdir(parents=True, exist_ok=True)

    # Rewards scaled to a spread of 1, observations left as pixels.
    env = VecNormalize(make_env(options.num_envs, options.seed, stagger=True), norm_obs=False)
    model = PPO(
        "CnnPolicy",
        env,
        n_steps=32,
        batch_size=4 * options.num_envs,
        n_epochs=4,
        learning_rate=LinearSchedule(1e-3, 0.0, 1.0),
        policy_kwargs={
            "features_extractor_kwargs": {"features_dim": 128},
            "net_arch": [],
            "log_std_init": -1.0,
        },
        seed=options.seed,
        verbose=0,
    )
    evaluations = EvalCallback(
        VecNormalize(make_env(5, options.seed + 10_000), norm_obs=False, norm_reward=False),
        n_eval_episodes=5,
        eval_freq=max(1, options.total_steps // options.num_envs // 10),
        log_path=str(options.output_dir),
        verbose=0,
    )
    started = time.perf_counter()
    model.learn(options.total_steps, callback=evaluations, progress_bar=True)
    seconds = time.perf_counter() - started
    mean, std = evaluate_policy(
        model,
        make_env(options.eval_episodes, options.seed + 1_000_000),
        n_eval_episodes=options.eval_episodes,
    )
    figures = {
        "eval_return_mean": float(mean),
        "eval_return_std": float(std),
        "train_seconds": seconds,
        "train_steps": model.num_timesteps,
        "curve": {
            "steps": evaluations.evaluations_timesteps,
            "return": [float(sum(r) / len(r)) for r in evaluations.evaluations_results],
        },
    }
    model.save(options.output_dir / "agent")
    (options.output_dir / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps({name: figures[name] for name in list(figures)[:4]}))
    return figures


if __name__ == "__main__":
    main()
