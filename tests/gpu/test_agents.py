"""Agents on an accelerator; run with `pytest -m gpu` and ``--xla_gpu_deterministic_ops=true``."""

from __future__ import annotations

import os

import jax
import numpy as np
import pytest
import torch

from pixelbrax_gym import TorchPolicy
from pixelbrax_jax.agents.runner.export import save_policy
from tests.agents.small import PHASIC, SMALL, Agent, ball_envs, same

pytestmark = pytest.mark.gpu


@pytest.fixture(autouse=True)
def _needs_a_gpu():
    if jax.devices()[0].platform != "gpu":
        pytest.fail("these tests need a GPU that JAX sees")


@pytest.mark.parametrize("name", ["ppo", "ppg", "dcpg"])
def test_the_same_key_gives_the_same_run(name):
    from pixelbrax_jax.agents.algorithms.registry import ALGORITHMS

    if "deterministic_ops=true" not in os.environ.get("XLA_FLAGS", ""):
        pytest.fail("set XLA_FLAGS=--xla_gpu_deterministic_ops=true")
    settings = SMALL | ({} if name == "ppo" else PHASIC)
    agent = Agent(ALGORITHMS[name](ALGORITHMS[name].config_class(**settings), ball_envs()))
    one, other = (agent.run(agent.init(), 4)[0] for _ in range(2))
    assert same(one, other)


def test_an_exported_policy_acts_on_tensors_of_the_gpu(tmp_path):
    from pixelbrax_jax.agents.algorithms.ppo import PPO, PPOConfig

    agent = Agent(PPO(PPOConfig(**SMALL), ball_envs()))
    networks = agent.init().networks
    path = save_policy(agent.algorithm, networks, tmp_path / "policy.jax")
    pixels = np.random.default_rng(0).integers(0, 256, (4, 18, 18, 6), np.uint8)
    action = TorchPolicy(path)(torch.from_numpy(pixels).cuda())
    assert action.is_cuda
    expected = agent.algorithm.act(networks, pixels)
    np.testing.assert_allclose(action.cpu().numpy(), expected, rtol=1e-3, atol=1e-4)
