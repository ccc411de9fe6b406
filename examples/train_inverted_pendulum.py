"""PPO in PyTorch learns to balance an inverted pendulum from pixels that JAX rendered.

    python examples/train_inverted_pendulum.py --output-dir runs/demo

The frames stay where JAX put them: ``make_vec(..., output="torch")`` hands them over by DLPack
without a copy. Training ends when an evaluation shows the task solved, or with Ctrl-C. Written into
the output folder: ``learning_curve.png``, ``trained_agent.mp4`` and ``figures.json``.

The algorithm is proximal policy optimisation (Schulman et al., arXiv 1707.06347) with
generalised advantage estimation (arXiv 1506.02438), a Gaussian policy, and a shared CNN.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path

# JAX and PyTorch take turns on the same cores; a PyTorch thread that spins while it waits for
# its siblings would keep JAX from running. Read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import gymnasium
import matplotlib
import numpy as np
import torch
from torch import nn
from tqdm import tqdm

import pixelbrax_gym  # noqa: F401  # registers PixelBrax/*
from pixelbrax_jax.video import write_frames

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@dataclass(frozen=True)
class Config:
    """Everything that decides a run; each field is a command-line option."""

    output_dir: str = "runs/demo"
    seed: int = 1
    device: str = "auto"  # where PyTorch works: auto, cpu or cuda
    env_id: str = "PixelBrax/InvertedPendulum-v0"
    image_size: int = 32  # pixels, square
    frame_stack: int = 2  # two frames show velocities
    num_envs: int = 128
    num_steps: int = 32  # per environment and iteration
    total_steps: int = 1_400_000  # at most
    eval_every: int = 100_000  # steps
    solved_return: float = 995.0  # mean of an evaluation at which training stops
    learning_rate: float = 1e-3  # annealed to 0
    gamma: float = 0.99
    gae_lambda: float = 0.95
    reward_scale: float = 0.05  # keeps values of order 1
    update_epochs: int = 4
    num_minibatches: int = 8
    clip_coef: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    initial_std: float = 0.37
    eval_episodes: int = 20
    video_steps: int = 400


class Agent(nn.Module):
    """A small CNN with a Gaussian policy head and a value head."""

    def __init__(self, image_size: int, channels: int, action_size: int, initial_std: float):
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(channels, 16, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(16, 32, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3),
            nn.ReLU(),
            nn.Flatten(),
        )
        with torch.no_grad():
            size = self.features(torch.zeros(1, channels, image_size, image_size)).shape[1]
        self.features.extend([nn.Linear(size, 128), nn.ReLU()])
        self.policy_mean = nn.Linear(128, action_size)
        self.value = nn.Linear(128, 1)
        self.log_std = nn.Parameter(torch.full((action_size,), float(np.log(initial_std))))
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.orthogonal_(layer.weight, np.sqrt(2))
                nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(self.policy_mean.weight, 0.01)
        nn.init.orthogonal_(self.value.weight, 1.0)

    def forward(self, pixels: torch.Tensor) -> tuple[torch.distributions.Normal, torch.Tensor]:
        """Policy and value of (B, H, W, C) uint8 pixels."""
        # Channels-last pixels become PyTorch's channels_last layout by a mere permute.
        images = pixels.permute(0, 3, 1, 2).float() / 255.0 - 0.5
        features = self.features(images)
        policy = torch.distributions.Normal(self.policy_mean(features), self.log_std.exp())
        return policy, self.value(features).squeeze(-1)


def make_envs(config: Config, num_envs: int) -> gymnasium.vector.VectorEnv:
    """The vector environment; autoreset is Gymnasium's default, ``next_step``."""
    return gymnasium.make_vec(
        config.env_id,
        num_envs=num_envs,
        output="torch",
        height=config.image_size,
        width=config.image_size,
        frame_stack=config.frame_stack,
    )


def advantages_of(
    rewards: torch.Tensor,
    values: torch.Tensor,
    terminated: torch.Tensor,
    done: torch.Tensor,
    config: Config,
) -> torch.Tensor:
    """Generalised advantage estimates, (T, N), from ``values`` of shape (T + 1, N).

    With next-step autoreset the observation after the last step of an episode is its true final
    one, hence ``values[t + 1]`` bootstraps a truncated episode rightly.
    """
    advantages = torch.zeros_like(rewards)
    ahead = torch.zeros_like(rewards[0])
    for t in reversed(range(rewards.shape[0])):
        target = rewards[t] + config.gamma * values[t + 1] * ~terminated[t]
        ahead = target - values[t] + config.gamma * config.gae_lambda * ahead * ~done[t]
        advantages[t] = ahead
    return advantages


class Rollouts:
    """Collects experience and remembers the returns of finished episodes."""

    def __init__(self, config: Config, device: torch.device):
        self.config, self.device = config, device
        self.envs = make_envs(config, config.num_envs)
        self.obs, _ = self.envs.reset(seed=config.seed)
        # Where an episode ended in the last step, the next one ignores the action.
        self.ended = torch.zeros(config.num_envs, dtype=torch.bool, device=device)
        self.returns: list[float] = []

    @torch.no_grad()
    def collect(self, agent: Agent) -> dict[str, torch.Tensor]:
        """``num_steps`` steps in every environment, flattened over time and environments."""
        keys = ("obs", "actions", "log_probs", "rewards", "terminated", "done", "valid", "values")
        steps: dict[str, list[torch.Tensor]] = {key: [] for key in keys}
        for _ in range(self.config.num_steps):
            obs = self.obs.to(self.device)
            policy, value = agent(obs)
            action = policy.sample()
            # Where PyTorch and JAX work on different devices, actions and frames are copied.
            action_there = action.to(self.obs.device)
            self.obs, reward, terminated, truncated, info = self.envs.step(action_there)
            terminated, truncated = terminated.to(self.device), truncated.to(self.device)
            done = terminated | truncated
            for key, tensor in (
                ("obs", obs),
                ("actions", action),
                ("log_probs", policy.log_prob(action).sum(-1)),
                ("rewards", reward.to(self.device) * self.config.reward_scale),
                ("terminated", terminated),
                ("done", done),
                ("valid", ~self.ended),
                ("values", value),
            ):
                steps[key].append(tensor)
            self.ended = done
            self.returns += info["episode_return"][done.to(info["episode_return"].device)].tolist()
        _, last_value = agent(self.obs.to(self.device))
        batch = {key: torch.stack(tensors) for key, tensors in steps.items()}
        values = torch.cat([batch["values"], last_value[None]])
        batch["advantages"] = advantages_of(
            batch["rewards"], values, batch["terminated"], batch["done"], self.config
        )
        batch["targets"] = batch["advantages"] + batch["values"]
        return {key: tensor.flatten(0, 1) for key, tensor in batch.items()}


def update(
    agent: Agent, optimizer: torch.optim.Optimizer, batch: dict[str, torch.Tensor], config: Config
) -> None:
    """PPO's clipped update on one batch of experience."""
    # The step that merely begins an episode taught nothing: its action was ignored.
    valid = batch["valid"].nonzero().squeeze(-1)
    for _ in range(config.update_epochs):
        for rows in valid[torch.randperm(len(valid), device=valid.device)].chunk(
            config.num_minibatches
        ):
            policy, value = agent(batch["obs"][rows])
            log_prob = policy.log_prob(batch["actions"][rows]).sum(-1)
            ratio = (log_prob - batch["log_probs"][rows]).exp()
            advantage = batch["advantages"][rows]
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            clipped = ratio.clamp(1 - config.clip_coef, 1 + config.clip_coef)
            policy_loss = -torch.min(ratio * advantage, clipped * advantage).mean()
            value_loss = 0.5 * (value - batch["targets"][rows]).square().mean()
            optimizer.zero_grad()
            (policy_loss + config.vf_coef * value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), config.max_grad_norm)
            optimizer.step()


class Evaluation:
    """Whole episodes under the policy's mean action, the same ones every time."""

    def __init__(self, config: Config, device: torch.device):
        self.config, self.device = config, device
        self.envs = make_envs(config, config.eval_episodes)

    @torch.no_grad()
    def play(self, agent: Agent) -> list[float]:
        """Returns, one per environment."""
        obs, _ = self.envs.reset(seed=self.config.seed + 1_000_000)
        returns = torch.zeros(self.config.eval_episodes)
        running = torch.ones(self.config.eval_episodes, dtype=torch.bool)
        while running.any():
            policy, _ = agent(obs.to(self.device))
            obs, reward, terminated, truncated, _ = self.envs.step(policy.mean.to(obs.device))
            returns += reward.cpu() * running
            running &= ~(terminated | truncated).cpu()
        return returns.tolist()


@contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collects Ctrl-C and SIGTERM, after which training ends with an evaluation."""
    asked: list[int] = []

    def ask(number: int, *_: object) -> None:
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)
        tqdm.write("Stopping with an evaluation and a video; a second Ctrl-C stops at once.")

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def train(config: Config, device: torch.device) -> tuple[Agent, dict]:
    """Trains an agent; returns it with the figures and the learning curve of the run."""
    started = time.perf_counter()
    rollouts, evaluation = Rollouts(config, device), Evaluation(config, device)
    channels, action_size = rollouts.obs.shape[-1], rollouts.envs.single_action_space.shape[0]
    agent = Agent(config.image_size, channels, action_size, config.initial_std).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=config.learning_rate, eps=1e-5)
    rollouts.collect(agent)  # compiles the environment; this experience is not used
    rollouts.returns.clear()
    setup_seconds = time.perf_counter() - started

    batch_size = config.num_envs * config.num_steps
    num_iterations = -(-config.total_steps // batch_size)
    curve: dict[str, list[float]] = {"steps": [], "return": []}
    evaluations: list[dict] = []
    started = time.perf_counter()
    bar = tqdm(total=num_iterations * batch_size, unit="step", unit_scale=True)
    with bar, stop_requests() as asked:
        for iteration in range(num_iterations):
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * (1 - iteration / num_iterations)
            update(agent, optimizer, rollouts.collect(agent), config)
            bar.update(batch_size)
            steps = (iteration + 1) * batch_size
            if recent := rollouts.returns[-config.num_envs :]:
                curve["steps"].append(steps)
                curve["return"].append(float(np.mean(recent)))
                bar.set_postfix({"return": f"{curve['return'][-1]:.0f}"})
            last = asked or iteration + 1 == num_iterations
            if last or steps // config.eval_every > (steps - batch_size) // config.eval_every:
                evaluations.append({"steps": steps, "returns": evaluation.play(agent)})
                if asked or np.mean(evaluations[-1]["returns"]) >= config.solved_return:
                    break
    seconds = time.perf_counter() - started
    rollouts.envs.close()
    evaluation.envs.close()
    return agent, {
        "setup_seconds": setup_seconds,
        "train_seconds": seconds,
        "train_steps": steps,
        "train_steps_per_second": steps / seconds,
        "train_episodes": len(rollouts.returns),
        "curve": curve,
        "evaluations": evaluations,
    }


@torch.no_grad()
def record(agent: Agent, config: Config, device: torch.device, path: Path) -> None:
    """Makes a video of the trained agent at 480 x 480 pixels, in the task's own time."""
    env = gymnasium.make(
        config.env_id,
        render_mode="rgb_array",
        output="torch",
        height=config.image_size,
        width=config.image_size,
        frame_stack=config.frame_stack,
    )
    obs, _ = env.reset(seed=config.seed + 2_000_000)
    frames = [env.render()]
    for _ in range(config.video_steps):
        policy, _ = agent(obs[None].to(device))
        obs, _, terminated, truncated, _ = env.step(policy.mean[0].to(obs.device))
        frames.append(env.render())
        if terminated or truncated:
            obs, _ = env.reset()
            frames.append(env.render())
    write_frames(path, frames, env.metadata["render_fps"])
    env.close()


def plot(curve: dict[str, list[float]], evaluations: list[dict], path: Path) -> None:
    """Training returns over steps, with the evaluations' means."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.plot(curve["steps"], curve["return"], label="training, mean of recent episodes")
    axes.plot(
        [one["steps"] for one in evaluations],
        [np.mean(one["returns"]) for one in evaluations],
        "o",
        color="tab:orange",
        label=f"evaluation, mean of {len(evaluations[-1]['returns'])} episodes",
    )
    axes.set(xlabel="environment steps", ylabel="return", title="Inverted pendulum from pixels")
    axes.set_ylim(bottom=0)
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def parse(arguments: list[str] | None = None) -> Config:
    """The command line as a ``Config``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for field in fields(Config):
        kind = type(field.default)
        option = "--" + field.name.replace("_", "-")
        parser.add_argument(option, type=kind, default=field.default, help=f"{field.default}")
    return Config(**vars(parser.parse_args(arguments)))


def main(arguments: list[str] | None = None) -> dict:
    """Trains, evaluates, makes a video; returns what ``figures.json`` holds."""
    config = parse(arguments)
    output = Path(config.output_dir)
    output.mkdir(parents=True, exist_ok=True)
    device = torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu")
        if config.device == "auto"
        else config.device
    )
    torch.manual_seed(config.seed)
    print(f"Training on {device} with {config.num_envs} environments; the first step compiles.")
    agent, figures = train(config, device)
    returns = figures["evaluations"][-1]["returns"]
    figures |= {
        "eval_return_mean": float(np.mean(returns)),
        "eval_return_std": float(np.std(returns)),
        "config": asdict(config),
        "torch_device": str(device),
        "processor": platform.processor() or platform.machine(),
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "gymnasium": gymnasium.__version__,
            "pixelbrax": version("pixelbrax"),
        },
    }
    plot(figures["curve"], figures["evaluations"], output / "learning_curve.png")
    record(agent, config, device, output / "trained_agent.mp4")
    (output / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(
        f"Evaluation over {len(returns)} episodes: {figures['eval_return_mean']:.0f} "
        f"+- {figures['eval_return_std']:.0f} of 1000; "
        f"trained at {figures['train_steps_per_second']:.0f} steps/s for "
        f"{figures['train_seconds']:.0f} s."
    )
    print(f"Learning curve, video and figures are in {output.resolve()}")
    return figures


if __name__ == "__main__":
    main()
