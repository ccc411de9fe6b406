"""skrl's wrapper and trainers on our vector environment."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from skrl import config
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.agents.torch.sac import SAC, SAC_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from torch import nn

from tests.clients.ball import make_vec

NUM_ENVS, STEPS = 3, 16

pytestmark = pytest.mark.filterwarnings(
    # skrl copies tensors by `torch.tensor`.
    "ignore:To copy construct from a tensor:UserWarning",
)


def layers(inputs, outputs):
    return nn.Sequential(nn.Linear(inputs, 8), nn.Tanh(), nn.Linear(8, outputs))


class Policy(GaussianMixin, Model):
    def __init__(self, **spaces):
        Model.__init__(self, device="cpu", **spaces)
        GaussianMixin.__init__(self)
        self.layers = layers(self.num_observations, 1)
        self.log_std = nn.Parameter(torch.zeros(1))

    def compute(self, inputs, role):
        return self.layers(inputs["observations"].float() / 255), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    def __init__(self, *, with_actions=False, **spaces):
        Model.__init__(self, device="cpu", **spaces)
        DeterministicMixin.__init__(self)
        self.with_actions = with_actions
        self.layers = layers(self.num_observations + with_actions, 1)

    def compute(self, inputs, role):
        x = inputs["observations"].float() / 255
        if self.with_actions:
            x = torch.cat([x, inputs["taken_actions"]], dim=1)
        return self.layers(x), {}


class Witness:
    """Keeps what the wrapped environment hands to the trainer."""

    def __init__(self, env):
        self.obs, self.rewards, self.images = [], [], []
        reset, step, render = env.reset, env.step, env.render

        def witness_reset():
            obs, info = reset()
            if not self.obs:
                self.obs.append(obs.clone())
            return obs, info

        def witness_step(actions):
            answer = step(actions)
            self.obs.append(answer[0].clone())
            self.rewards.append(answer[1].clone())
            return answer

        def witness_render():
            self.images.append(render())

        env.reset, env.step, env.render = witness_reset, witness_step, witness_render


def make_agent(kind, env, folder):
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    memory = RandomMemory(memory_size=STEPS, num_envs=NUM_ENVS, device="cpu")
    experiment = {"directory": str(folder), "write_interval": 0, "checkpoint_interval": 0}
    if kind == "PPO":
        models = {"policy": Policy(**spaces), "value": Value(**spaces)}
        cfg = PPO_CFG(rollouts=STEPS, learning_epochs=1, mini_batches=2, experiment=experiment)
        return PPO(models=models, memory=memory, cfg=cfg, device="cpu", **spaces)
    critics = ("critic_1", "critic_2", "target_critic_1", "target_critic_2")
    models = {"policy": Policy(**spaces)}
    models |= {name: Value(with_actions=True, **spaces) for name in critics}
    cfg = SAC_CFG(batch_size=8, learning_starts=4, experiment=experiment)
    return SAC(models=models, memory=memory, cfg=cfg, device="cpu", **spaces)


@pytest.mark.parametrize("kind", ["PPO", "SAC"])
@pytest.mark.parametrize("output", ["torch", "numpy"])
def test_the_default_trainer_learns_from_our_frames(kind, output, tmp_path):
    options = {"render_mode": "rgb_array", "render_height": 8, "render_width": 8}
    env = wrap_env(make_vec(NUM_ENVS, autoreset_mode="same_step", output=output, **options))
    witness = Witness(env)
    agent = make_agent(kind, env, tmp_path)
    before = [p.detach().clone() for p in agent.models["policy"].parameters()]
    SequentialTrainer(
        env=env,
        agents=agent,
        # Not headless: it renders every step.
        cfg={"timesteps": STEPS, "close_environment_at_exit": False, "disable_progressbar": True},
    ).train()

    # skrl makes floats of NumPy arrays and leaves tensors what they are.
    assert witness.obs[0].dtype == (torch.uint8 if output == "torch" else torch.float32)
    stored = agent.memory.get_tensor_by_name("observations")
    assert_array_equal(stored, torch.stack(witness.obs[:STEPS]))
    # PPO's advantages are shaped in place, the rewards are not.
    assert_array_equal(agent.memory.get_tensor_by_name("rewards"), torch.stack(witness.rewards))
    assert np.shape(witness.images) == (STEPS, NUM_ENVS, 8, 8, 3)

    after = list(agent.models["policy"].parameters())
    assert all(p.isfinite().all() for p in after)
    assert any((p != q).any() for p, q in zip(after, before, strict=True))
    expected = replay(config.torch.key, agent.memory.get_tensor_by_name("actions"))
    assert_array_equal(torch.stack(witness.obs[:STEPS]), expected)


def replay(seed, actions):
    """The frames that the same actions lead to, seen without skrl."""
    env = make_vec(NUM_ENVS, autoreset_mode="same_step")
    frames = [env.reset(seed=seed)[0]]
    frames += [env.step(action.numpy())[0] for action in actions[:-1]]
    return np.stack(frames).reshape(STEPS, NUM_ENVS, -1)
