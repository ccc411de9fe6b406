"""How much of the simulator's state can be read off a trained encoder's features, as JSON.

    python -m tests.benchmarks.probe runs/ppo

A linear map (ridge regression) from features to each entry of the state is fitted on half of the
environments, under the trained policy with its noise, and judged on the other half: R^2, 1 where
the features have all of it and 0 where they have nothing. Beside them are the pixels, averaged to
12 x 12, and a new encoder of the same kind that learns the state itself from the first half.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn

from pixelbrax_jax import VectorPixelEnv
from pixelbrax_jax.agents.config import make_env
from pixelbrax_jax.agents.networks.encoders import ENCODERS, scaled
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


class Regression(nn.Module):
    """An encoder, and a linear map from its features."""

    encoder: str
    size: int

    @nn.compact
    def __call__(self, pixels: jax.Array) -> jax.Array:
        """Map (B, H, W, C) uint8 to (B, S)."""
        return nn.Dense(self.size)(ENCODERS[self.encoder]()(scaled(pixels)))


def learned(
    encoder: str, pixels: np.ndarray, targets: np.ndarray, updates: int, batch: int = 128
) -> np.ndarray:
    """R^2, (S,), of an encoder that learns the targets of half of the environments.

    Args:
        encoder: its name.
        pixels: (T, N, H, W, C) uint8.
        targets: (T, N, S).
        updates: of Adam, with a step size of 0.001.
        batch: samples of an update.
    """
    half = pixels.shape[1] // 2
    center, scale = targets[:, :half].mean((0, 1)), targets[:, :half].std((0, 1))
    targets = ((targets - center) / scale).astype(np.float32)
    model, optimizer = Regression(encoder, targets.shape[-1]), optax.adam(1e-3)
    params = model.init(jax.random.key(0), pixels[0, :1])
    opt_state = optimizer.init(params)

    @jax.jit
    def update(params: Any, opt_state: Any, x: jax.Array, y: jax.Array) -> tuple[Any, Any]:
        gradient = jax.grad(lambda params: jnp.mean((model.apply(params, x) - y) ** 2))(params)
        changes, opt_state = optimizer.update(gradient, opt_state)
        return optax.apply_updates(params, changes), opt_state

    random = np.random.default_rng(0)
    for _ in range(updates):
        chosen = random.integers(len(pixels), size=batch), random.integers(half, size=batch)
        params, opt_state = update(params, opt_state, pixels[chosen], targets[chosen])
    predict = jax.jit(model.apply)
    wrong = np.stack([predict(params, x[half:]) for x in pixels]) - targets[:, half:]
    found = 1.0 - (wrong**2).mean((0, 1)) / targets[:, half:].var((0, 1))
    return found.astype(np.float64)


def probe(folder: Path, num_envs: int, num_steps: int, updates: int) -> dict:
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
            kept = output.features, obs["pixels"], obs["state"]
            action = output.policy.action(output.policy.sample(key))
            return envs.step(state, action, params)[0], kept

        state, _ = envs.reset(key, params)
        return jax.lax.scan(step, state, jax.random.split(key, num_steps))[1]

    features, pixels, state = (np.asarray(x) for x in play(jax.random.key(1), params))
    height, width, channels = pixels.shape[2:]
    if height % 12 or width % 12:
        raise SystemExit(f"frames must be multiples of 12, got {height} x {width}")
    # Means over squares, as the encoders' first layers of patches see them.
    squares = (num_steps, num_envs, 12, height // 12, 12, width // 12, channels)
    coarse = pixels.reshape(squares).mean((3, 5), dtype=np.float32)
    coarse = coarse.reshape(num_steps, num_envs, -1)
    # What never changes cannot be told.
    half, state = num_envs // 2, state.astype(np.float64)
    change = np.minimum(state[:, :half].std((0, 1)), state[:, half:].std((0, 1)))
    moving = state[..., change > 1e-6]
    found = {
        "features": explained(features.astype(np.float64), moving),
        "pixels": explained(coarse.astype(np.float64), moving),
        "learned": learned(algorithm.config.encoder, pixels, moving, updates),
    }
    return {
        "task": algorithm.config.task,
        "agent": algorithm.name,
        "steps": agent.steps,
        "median": {name: round(float(np.median(x)), 2) for name, x in found.items()},
    } | {name: np.round(x, 3).tolist() for name, x in found.items()}


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, help="of training runs")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=1024)
    parser.add_argument("--updates", type=int, default=4000, help="of the new encoder")
    options = parser.parse_args()
    for folder in options.folders:
        found = probe(folder, options.num_envs, options.num_steps, options.updates)
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
