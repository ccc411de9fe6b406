"""How much of the simulator's state can be read off a trained encoder's features, as JSON.

    python -m tests.benchmarks.probe runs/ppo

A linear map (ridge regression) from features to each entry of the state is fitted on half of the
environments, under the trained policy with its noise, and judged on the other half: R^2, 1 where
the features have all of it and 0 where they have nothing. The pixels themselves are beside them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import VectorPixelEnv
from pixelbrax_jax.agents.core.config import make_env
from pixelbrax_jax.agents.runner.trained import load_trained


def explained(inputs: np.ndarray, targets: np.ndarray, penalty: float = 1e-3) -> np.ndarray:
    """R^2 of a ridge regression, (S,), of (T, N, F) inputs and (T, N, S) targets."""
    half = inputs.shape[1] // 2
    parts = [
        (
            inputs[:, part].reshape(-1, inputs.shape[-1]),
            targets[:, part].reshape(-1, targets.shape[-1]),
        )
        for part in (slice(half), slice(half, None))
    ]
    (x, y), (x_test, y_test) = parts
    center, scale = x.mean(0), x.std(0) + 1e-6
    x, x_test = (x - center) / scale, (x_test - center) / scale
    weights = np.linalg.solve(
        x.T @ x + penalty * len(x) * np.eye(x.shape[1]), x.T @ (y - y.mean(0))
    )
    wrong = ((y_test - y.mean(0) - x_test @ weights) ** 2).mean(0)
    return 1.0 - wrong / (y_test.var(0) + 1e-12)


def probe(folder: Path, num_envs: int, num_steps: int) -> dict:
    """Play, and fit."""
    agent = load_trained(folder)
    algorithm, networks = agent.algorithm, agent.networks
    env, params = make_env(algorithm.config, obs_mode="both")
    envs = VectorPixelEnv(env, num_envs)

    @jax.jit
    def play(key, params):
        def step(state, key):
            obs = envs.obs(state)
            output = algorithm.agent.actor(networks["actor"], obs["pixels"])
            coarse = jax.image.resize(
                obs["pixels"].astype(jnp.float32),
                (num_envs, 12, 12, obs["pixels"].shape[-1]),
                "linear",
            )
            kept = output.features, coarse.reshape(num_envs, -1), obs["state"]
            action = output.policy.action(output.policy.sample(key))
            return envs.step(state, action, params)[0], kept

        state, _ = envs.reset(key, params)
        return jax.lax.scan(step, state, jax.random.split(key, num_steps))[1]

    features, pixels, state = (np.asarray(x, np.float64) for x in play(jax.random.key(1), params))
    # What never changes cannot be told.
    moving = state.std((0, 1)) > 1e-6
    return {
        "task": algorithm.config.task,
        "steps": agent.steps,
        "features": np.round(explained(features, state)[moving], 3).tolist(),
        "pixels": np.round(explained(pixels, state)[moving], 3).tolist(),
    }


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, help="of training runs")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=128)
    options = parser.parse_args()
    for folder in options.folders:
        print(json.dumps(probe(folder, options.num_envs, options.num_steps)), flush=True)


if __name__ == "__main__":
    main()
