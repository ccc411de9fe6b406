"""Tianshou's vector environments, collectors and trainers on our single environment."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from tianshou.algorithm import PPO, SAC
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.modelfree.sac import SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, SubprocVectorEnv
from tianshou.trainer import OffPolicyTrainerParams, OnPolicyTrainerParams
from tianshou.utils.net.common import ModuleWithVectorOutput
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch import nn
from torch.distributions import Independent, Normal

from tests.clients.ball import ACTIONS, LIMIT, assert_same_images, make, make_vec, play

VENVS = {
    "dummy": lambda makers: DummyVectorEnv(makers),
    "subproc": lambda makers: SubprocVectorEnv(makers, context="spawn"),
}


@pytest.mark.parametrize("kind", VENVS)
def test_its_vector_environments_hand_out_what_ours_does(kind):
    env = VENVS[kind]([make] * 2)
    ours = make_vec(2, autoreset_mode="same_step")
    # Seeding begins an episode that nobody sees.
    env.seed([5, 6]), ours.reset(seed=5)
    (obs, _), (expected, _) = env.reset(), ours.reset()
    assert_same_images(np.stack(obs), expected)
    for action in ACTIONS[:LIMIT]:
        obs, rewards, terminated, truncated, _ = env.step(np.stack([action, -action]))
        step = ours.step(np.stack([action, -action]))
        last = step[4].get("final_obs", step[0])
        assert_same_images(np.stack(obs), np.stack(list(last)))
        assert_allclose(rewards, step[1], rtol=1e-6)
        assert_array_equal(terminated, step[2])
        assert_array_equal(truncated, step[3])
    assert truncated.all()
    env.close()


class Pixels(ModuleWithVectorOutput):
    """Features of channels-last frames."""

    def __init__(self, with_actions=False):
        super().__init__(8)
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(12 * 12 * 3, 8), nn.Tanh())

    def forward(self, obs, state=None, info=None):
        return self.layers(torch.as_tensor(obs, dtype=torch.float32) / 255), state


def make_actor(conditioned_sigma):
    return ContinuousActorProbabilistic(
        preprocess_net=Pixels(),
        action_shape=(1,),
        unbounded=True,
        conditioned_sigma=conditioned_sigma,
    )


def normal(mean_and_deviation):
    return Independent(Normal(*mean_and_deviation), 1)


def make_ppo(env):
    policy = ProbabilisticActorPolicy(
        actor=make_actor(conditioned_sigma=False),
        dist_fn=normal,
        action_space=env.action_space[0],
    )
    critic = ContinuousCritic(preprocess_net=Pixels())
    return PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-2))


def make_sac(env):
    policy = SACPolicy(actor=make_actor(conditioned_sigma=True), action_space=env.action_space[0])

    def critic():
        return ContinuousCritic(
            preprocess_net=PixelsAndActions(), apply_preprocess_net_to_obs_only=True
        )

    return SAC(
        policy=policy,
        policy_optim=AdamOptimizerFactory(lr=1e-2),
        critic=critic(),
        critic_optim=AdamOptimizerFactory(lr=1e-2),
    )


class PixelsAndActions(Pixels):
    """Features of frames, for a critic that appends the action."""

    def __init__(self):
        super().__init__()
        self.output_dim = 9

    def forward(self, obs, state=None, info=None):
        return super().forward(obs)[0], state


def train(algorithm, collector, kind):
    common = {
        "training_collector": collector,
        "max_epochs": 1,
        "epoch_num_steps": 48,
        "collection_step_num_env_steps": 24,
        "batch_size": 8,
    }
    if kind == "PPO":
        params = OnPolicyTrainerParams(**common, update_step_num_repetitions=1)
    else:
        params = OffPolicyTrainerParams(**common, update_step_num_gradient_steps_per_sample=0.2)
    return algorithm.run_training(params)


@pytest.mark.parametrize("kind", ["PPO", "SAC"])
def test_learns_from_what_its_collector_gathers(kind):
    env = DummyVectorEnv([make] * 2)
    algorithm = make_ppo(env) if kind == "PPO" else make_sac(env)
    before = [p.detach().clone() for p in algorithm.parameters()]
    collector = Collector(algorithm, env, VectorReplayBuffer(96, 2))
    collector.reset()
    if kind == "SAC":
        collector.collect(n_step=24)
    result = train(algorithm, collector, kind)
    assert result is not None
    after = list(algorithm.parameters())
    assert all(p.isfinite().all() for p in after)
    assert any((p != q).any() for p, q in zip(after, before, strict=True))


@pytest.mark.parametrize("kind", VENVS)
def test_its_collector_gathers_true_transitions(kind):
    env = VENVS[kind]([make] * 2)
    policy = make_ppo(env).policy
    collector = Collector(policy, env, VectorReplayBuffer(48, 2))
    collector.reset(gym_reset_kwargs={"seed": 5})
    stats = collector.collect(n_step=2 * LIMIT)
    assert_array_equal(stats.lens, [LIMIT, LIMIT])
    for i, buffer in enumerate(collector.buffer.buffers):
        steps = buffer.sample_indices(0)
        batch = buffer[np.sort(steps)]
        assert batch.obs.dtype == np.uint8
        actions = np.clip(batch.act, -1, 1)
        plain = play(make(), actions, seed=5)
        assert_array_equal(batch.obs, plain.obs[:-1])
        assert_array_equal(batch.obs_next, plain.obs[1:])
        assert_allclose(batch.rew, plain.rewards, rtol=1e-5)
        assert stats.returns[i] == pytest.approx(sum(plain.rewards), rel=1e-5)
    env.close()
