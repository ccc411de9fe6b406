"""TorchRL's PPO balances an inverted pendulum from pixels.

    python examples/torchrl_ppo.py

Collector, generalised advantage estimation and loss are TorchRL's own. Frames stay on the
memory that JAX wrote until the collector stacks them into a batch.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

# JAX and PyTorch take turns on the same cores; see docs/troubleshooting.md.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import ExplorationType, RewardSum, TransformedEnv, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from pixelbrax_gym import TorchRLEnv

SIZE, FRAMES = 32, 2


class Pixels(nn.Module):
    """(..., H, W, C) uint8 pixels as features."""

    def __init__(self, features: int = 128):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3 * FRAMES, 16, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(16, 32, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * 4 * 4, features),
            nn.ReLU(),
        )
        for layer in self.layers:
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        batch = pixels.shape[:-3]
        # A view in PyTorch's channels_last layout.
        images = pixels.reshape(-1, *pixels.shape[-3:]).permute(0, 3, 1, 2)
        return self.layers(images.float().div_(255.0).sub_(0.5)).unflatten(0, batch)


class Policy(nn.Module):
    """Features as mean and standard deviation of a Gaussian."""

    def __init__(self, action_size: int):
        super().__init__()
        self.mean = nn.Linear(128, action_size)
        self.log_std = nn.Parameter(torch.full((action_size,), -1.0))
        nn.init.orthogonal_(self.mean.weight, 0.01)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean(features)
        return mean, self.log_std.exp().expand_as(mean)


def make_env(num_envs: int, seed: int, device: torch.device) -> TransformedEnv:
    """Pixel environments that sum up the rewards of their episodes."""
    env = TorchRLEnv(
        "inverted_pendulum", num_envs, height=SIZE, width=SIZE, frame_stack=FRAMES, device=device
    )
    env.set_seed(seed)
    return TransformedEnv(env, RewardSum())


def make_networks(env: TransformedEnv) -> tuple[ProbabilisticActor, ValueOperator, nn.Module]:
    """Policy, value of features, and value of pixels; all share the features."""
    pixels = TensorDictModule(Pixels(), in_keys=["pixels"], out_keys=["features"])
    head = TensorDictModule(
        Policy(env.action_spec.shape[-1]), in_keys=["features"], out_keys=["loc", "scale"]
    )
    actor = ProbabilisticActor(
        TensorDictSequential(pixels, head),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = ValueOperator(nn.Linear(128, 1), in_keys=["features"])
    return actor.to(env.device), value.to(env.device), TensorDictSequential(pixels, value)


@torch.no_grad()
def evaluate(actor: TensorDictSequential, episodes: int, seed: int, device: torch.device) -> list:
    """Returns of whole episodes under the policy's mean action."""
    env = make_env(episodes, seed, device)
    td = env.reset()
    returns = torch.full((episodes,), torch.nan)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while returns.isnan().any():
            stepped, td = env.step_and_maybe_reset(actor(td))
            first = stepped["next", "done"].flatten().cpu() & returns.isnan()
            returns[first] = stepped["next", "episode_reward"].flatten().cpu()[first]
    env.close()
    return returns.tolist()


def main(arguments: list[str] | None = None) -> dict:
    """Trains and evaluates; returns the figures that it prints."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--total-steps", type=int, default=700_000)
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--num-steps", type=int, default=32)
    parser.add_argument("--eval-episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--output-dir", type=Path, default=Path("runs/torchrl_ppo"))
    options = parser.parse_args(arguments)
    options.output_dir.mkdir(parents=True, exist_ok=True)
    device = torch.device(options.device)
    torch.manual_seed(options.seed)

    env = make_env(options.num_envs, options.seed, device)
    actor, value, value_of_pixels = make_networks(env)
    batch_size = options.num_envs * options.num_steps
    num_batches = -(-options.total_steps // batch_size)
    collector = Collector(
        env,
        actor,
        frames_per_batch=batch_size,
        total_frames=num_batches * batch_size,
        auto_register_policy_transforms=False,  # the policy has no memory
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=value_of_pixels)
    loss = ClipPPOLoss(
        actor,
        value,  # of the features that the actor has just computed
        clip_epsilon=0.2,
        entropy_bonus=False,
        critic_coeff=0.5,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, eps=1e-5)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, num_batches)
    minibatches = ReplayBuffer(
        storage=LazyTensorStorage(batch_size, device=device),
        sampler=SamplerWithoutReplacement(),
        batch_size=batch_size // 8,
    )

    curve: dict[str, list[float]] = {"steps": [], "return": []}
    started = time.perf_counter()
    with tqdm(total=num_batches * batch_size, unit="step", unit_scale=True) as bar:
        for batch in collector:
            bar.update(batch_size)
            done = batch["next", "done"]
            if done.any():
                curve["steps"].append(bar.n)
                curve["return"].append(batch["next", "episode_reward"][done].mean().item())
                bar.set_postfix({"return": f"{curve['return'][-1]:.0f}"})
            batch["next", "reward"] *= 0.05  # keeps values of order 1
            with torch.no_grad():
                batch = advantage(batch)
            keys = ("pixels", "action", "action_log_prob", "advantage", "value_target")
            minibatches.extend(batch.select(*keys).reshape(-1))
            for _ in range(4):
                for minibatch in minibatches:
                    losses = loss(minibatch)
                    optimizer.zero_grad()
                    sum(losses[key] for key in ("loss_objective", "loss_critic")).backward()
                    nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                    optimizer.step()
            schedule.step()
    seconds = time.perf_counter() - started
    collector.shutdown()
    returns = evaluate(actor, options.eval_episodes, options.seed + 1_000_000, device)
    figures = {
        "eval_return_mean": float(np.mean(returns)),
        "eval_return_std": float(np.std(returns)),
        "train_seconds": seconds,
        "train_steps": num_batches * batch_size,
        "curve": curve,
    }
    (options.output_dir / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps({name: figures[name] for name in list(figures)[:4]}))
    return figures


if __name__ == "__main__":
    main()
