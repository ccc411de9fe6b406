"""Agents on an accelerator; run with `make test-gpu`."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from pixelbrax_gym import TorchPolicy
from pixelbrax_jax.agents.runner.trained import save_policy
from tests.agents.small import SMALL, Agent, ball_envs, same, small_agent
from tests.gpu.processes import deterministic

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("name", ["ppo", "ppg", "dcpg", "drqv2"])
def test_the_same_key_gives_the_same_run(name):
    from pixelbrax_jax.agents.registry import ALGORITHMS

    agent = small_agent(ALGORITHMS[name])
    one, other = (agent.run(agent.init(), 4)[0] for _ in range(2))
    assert same(one, other)


def test_an_exported_policy_acts_on_tensors_of_the_device(tmp_path, device):
    from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig

    agent = Agent(PPO(PPOConfig(**SMALL), ball_envs()))
    networks = agent.init().networks
    path = save_policy(agent.algorithm, networks, tmp_path / "policy.jax")
    pixels = np.random.default_rng(0).integers(0, 256, (4, 18, 18, 6), np.uint8)
    action = TorchPolicy(path)(torch.from_numpy(pixels).to(device))
    assert action.device.type == device
    expected = agent.algorithm.act(networks, pixels)
    np.testing.assert_allclose(action.cpu().numpy(), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.cuda_only
@pytest.mark.timeout(1800)
def test_ppo_learns_to_balance(tmp_path):
    """A smoke test: as on a CPU, the pole stands for most of an episode in the end."""
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "pixelbrax_gym.cli", "train", "ppo", "--preset", "ci"]
    command += ["--task", "inverted_pendulum", "--num-evals", "1"]
    command += ["--eval-episodes", "32", "--output-dir", str(folder)]
    subprocess.run(command, check=True, timeout=1500, env=deterministic())
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    returns = [row["eval/clean/return"] for row in rows if "eval/clean/return" in row]
    assert returns[-1] > 500.0
