"""skrl's PPO on pixels, through Gymnasium's vector interface alone.

    pip install "skrl[torch]"
    python examples/skrl_ppo.py

skrl knows nothing of PixelBrax: ``wrap_env`` takes what ``gymnasium.make_vec`` returns. It reads
the observation of a step as the one to act on next, hence ``autoreset_mode="same_step"``.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from torch import nn

import pixelbrax_gym  # noqa: F401  # registers PixelBrax/*

SHAPE = (32, 32, 6)


class Policy(GaussianMixin, Model):
    """A Gaussian whose mean comes from a small CNN."""

    def __init__(self, observation_space, action_space, device):
        Model.__init__(
            self, observation_space=observation_space, action_space=action_space, device=device
        )
        GaussianMixin.__init__(self, clip_actions=False)
        self.layers = make_layers(self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs, role):  # noqa: ARG002  # skrl's signature
        return self.layers(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """A value function of the same make."""

    def __init__(self, observation_space, action_space, device):
        Model.__init__(
            self, observation_space=observation_space, action_space=action_space, device=device
        )
        DeterministicMixin.__init__(self)
        self.layers = make_layers(1)

    def compute(self, inputs, role):  # noqa: ARG002  # skrl's signature
        return self.layers(inputs["observations"]), {}


class Images(nn.Module):
    """skrl's flat float observations as channels-first images around 0."""

    def forward(self, flat):
        return flat.reshape(-1, *SHAPE).permute(0, 3, 1, 2) / 255.0 - 0.5


def make_layers(outputs: int) -> nn.Sequential:
    """A small CNN."""
    return nn.Sequential(
        Images(),
        nn.Conv2d(SHAPE[-1], 16, 4, stride=2),
        nn.ReLU(),
        nn.Conv2d(16, 32, 4, stride=2),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(32 * 6 * 6, 128),
        nn.ReLU(),
        nn.Linear(128, outputs),
    )


def main(arguments: list[str] | None = None) -> PPO:
    """Trains; returns the agent."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--timesteps", type=int, default=5000, help="steps of each environment")
    parser.add_argument("--output-dir", default="runs/skrl_ppo")
    options = parser.parse_args(arguments)

    env = wrap_env(
        gymnasium.make_vec(
            "PixelBrax/InvertedPendulum-v0",
            num_envs=options.num_envs,
            autoreset_mode="same_step",
            height=SHAPE[0],
            width=SHAPE[1],
            frame_stack=SHAPE[2] // 3,
        )
    )
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    agent = PPO(
        models={
            "policy": Policy(**spaces, device=env.device),
            "value": Value(**spaces, device=env.device),
        },
        memory=RandomMemory(memory_size=32, num_envs=env.num_envs, device=env.device),
        **spaces,
        device=env.device,
        cfg=PPO_CFG(
            rollouts=32,
            learning_epochs=4,
            mini_batches=8,
            learning_rate=5e-4,
            rewards_shaper=lambda rewards, *_: rewards * 0.05,
            experiment={"directory": options.output_dir, "write_interval": 1000},
        ),
    )
    SequentialTrainer(
        env=env,
        agents=agent,
        cfg={
            "timesteps": options.timesteps,
            "headless": True,
            "close_environment_at_exit": False,
        },
    ).train()
    env.close()
    return agent


if __name__ == "__main__":
    main()
