"""PPO from pixels in one file, in CleanRL's manner: Gymnasium, PyTorch and nothing of ours.

The script knows an id and makes it by ``gymnasium.vector.SyncVectorEnv`` or ``make_vec``; both
reset in the step after an episode's end, which it leaves out of the loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal


@dataclass
class Args:
    """Those that CleanRL's scripts have."""

    env_id: str
    env_options: dict
    seed: int = 1
    num_envs: int = 3
    num_steps: int = 16
    num_iterations: int = 2
    num_minibatches: int = 2
    update_epochs: int = 2
    learning_rate: float = 1e-3
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_coef: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5


def make_env(args: Args) -> Callable[[], gym.Env]:
    """One environment with the wrappers that CleanRL puts around Atari and MuJoCo."""

    def thunk() -> gym.Env:
        env = gym.make(args.env_id, **args.env_options)
        env = gym.wrappers.RecordEpisodeStatistics(env)
        env = gym.wrappers.ClipAction(env)
        env = gym.wrappers.GrayscaleObservation(env)
        return gym.wrappers.FrameStackObservation(env, 2)

    return thunk


def make_sync(args: Args) -> gym.vector.VectorEnv:
    """Single environments one after the other."""
    return gym.vector.SyncVectorEnv([make_env(args) for _ in range(args.num_envs)])


def make_fast(args: Args) -> gym.vector.VectorEnv:
    """All in one program; frames are stacked inside of it."""
    envs = gym.make_vec(args.env_id, num_envs=args.num_envs, **args.env_options)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    return gym.wrappers.vector.ClipAction(envs)


def layer_init(layer: nn.Module, std: float = 2**0.5) -> nn.Module:
    """Orthogonal weights, no bias."""
    nn.init.orthogonal_(layer.weight, std)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """A small CNN with two heads."""

    def __init__(self, envs: gym.vector.VectorEnv) -> None:
        super().__init__()
        # Images are square: what differs from the two others is the channels.
        first, second, _ = envs.single_observation_space.shape
        self.channels_last = first == second
        shape = self.as_images(torch.zeros(1, *envs.single_observation_space.shape)).shape
        self.network = nn.Sequential(
            layer_init(nn.Conv2d(shape[1], 8, 4, stride=2)), nn.ReLU(), nn.Flatten()
        )
        features = self.network(torch.zeros(shape)).shape[1]
        self.actor = layer_init(nn.Linear(features, envs.single_action_space.shape[0]), 0.01)
        self.logstd = nn.Parameter(torch.zeros(1, envs.single_action_space.shape[0]))
        self.critic = layer_init(nn.Linear(features, 1), 1.0)

    def as_images(self, x: torch.Tensor) -> torch.Tensor:
        """Channels first, around 0."""
        return (x.permute(0, 3, 1, 2) if self.channels_last else x) / 255.0 - 0.5

    def get_action_and_value(self, x, action=None):
        """Action, its log-probability, the entropy, the value."""
        hidden = self.network(self.as_images(x.float()))
        probs = Normal(self.actor(hidden), self.logstd.exp())
        action = probs.sample() if action is None else action
        value = self.critic(hidden).flatten()
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), value


def main(args: Args, envs: gym.vector.VectorEnv) -> dict:
    """Trains; returns the agent, the returns it logged, and every step as it was stored."""
    torch.manual_seed(args.seed)
    agent = Agent(envs)
    before = [p.detach().clone() for p in agent.parameters()]
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    obs_shape, action_shape = envs.single_observation_space.shape, envs.single_action_space.shape
    size = (args.num_steps, args.num_envs)
    episodes, log = [], {"obs": [], "actions": [], "rewards": [], "dones": []}

    next_obs, _ = envs.reset(seed=args.seed)
    next_obs = torch.tensor(next_obs)
    next_done = torch.zeros(args.num_envs)
    for _ in range(args.num_iterations):
        obs = torch.zeros((*size, *obs_shape), dtype=torch.uint8)
        actions = torch.zeros((*size, *action_shape))
        logprobs, rewards, dones, values = (torch.zeros(size) for _ in range(4))
        for step in range(args.num_steps):
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                action, logprobs[step], _, values[step] = agent.get_action_and_value(next_obs)
            actions[step] = action
            next_obs, reward, terminations, truncations, infos = envs.step(action.numpy())
            rewards[step] = torch.tensor(reward)
            next_obs = torch.tensor(next_obs)
            next_done = torch.tensor(np.logical_or(terminations, truncations)).float()
            if "episode" in infos:
                told, rows = infos["episode"], np.flatnonzero(infos["_episode"])
                episodes += [(told["r"][i], told["l"][i]) for i in rows]

        with torch.no_grad():
            next_value = agent.get_action_and_value(next_obs)[3]
            advantages, last = torch.zeros(size), 0.0
            for t in reversed(range(args.num_steps)):
                alive = 1.0 - (next_done if t == args.num_steps - 1 else dones[t + 1])
                after = next_value if t == args.num_steps - 1 else values[t + 1]
                delta = rewards[t] + args.gamma * after * alive - values[t]
                advantages[t] = last = delta + args.gamma * args.gae_lambda * alive * last
            returns = advantages + values

        flat = [x.flatten(0, 1) for x in (obs, actions, logprobs, advantages, returns)]
        # The step after an end only resets.
        (real,) = torch.where(dones.flatten() == 0)
        for _ in range(args.update_epochs):
            for rows in real[torch.randperm(len(real))].chunk(args.num_minibatches):
                b_obs, b_actions, b_logprobs, b_advantages, b_returns = (x[rows] for x in flat)
                _, logprob, entropy, value = agent.get_action_and_value(b_obs, b_actions)
                ratio = (logprob - b_logprobs).exp()
                b_advantages = (b_advantages - b_advantages.mean()) / (b_advantages.std() + 1e-8)
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                policy_loss = -torch.min(b_advantages * ratio, b_advantages * clipped).mean()
                value_loss = 0.5 * ((value - b_returns) ** 2).mean()
                loss = policy_loss - args.ent_coef * entropy.mean() + args.vf_coef * value_loss
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()
        for name, kept in (("obs", obs), ("actions", actions), ("rewards", rewards)):
            log[name].append(kept)
        log["dones"].append(dones)
    envs.close()
    steps = {name: torch.cat(parts).numpy() for name, parts in log.items()}
    return {"agent": agent, "before": before, "episodes": episodes} | steps
