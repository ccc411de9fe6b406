"""Every algorithm of Stable-Baselines3 and sb3-contrib learns from our images."""

from __future__ import annotations

from copy import deepcopy

import gymnasium
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch
from gymnasium.wrappers import DiscretizeAction
from numpy.testing import assert_array_equal
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecExtractDictObs,
)

from pixelbrax_gym import SB3VecEnv
from tests.clients.ball import ACTIONS, ID, SIZE, TASK, assert_same_images, make

NUM_ENVS = 2
# The smallest image that the CNN of Stable-Baselines3 takes.
OPTIONS = SIZE | {"height": 36, "width": 36}

# Of networks that fit into a test.
SMALL = {"net_arch": [8]}
ROLLOUTS = {"n_steps": 8, "policy_kwargs": SMALL}
REPLAY = {"buffer_size": 200, "learning_starts": 16, "batch_size": 8, "policy_kwargs": SMALL}

# Class: options, the observations it takes, and whether its actions are numbers.
ALGORITHMS = {
    "A2C": (ROLLOUTS, ("pixels", "both", "state"), False),
    "PPO": (ROLLOUTS | {"batch_size": 8}, ("pixels", "both", "state"), False),
    "DDPG": (REPLAY, ("pixels", "both", "state"), False),
    "SAC": (REPLAY, ("pixels", "both", "state"), False),
    "TD3": (REPLAY, ("pixels", "both", "state"), False),
    "DQN": (REPLAY, ("pixels", "both", "state"), True),
    "ARS": ({"n_delta": 2, "policy_kwargs": SMALL}, ("state",), False),
    "CrossQ": (REPLAY, ("state",), False),
    "MaskablePPO": (ROLLOUTS | {"batch_size": 8}, ("pixels", "both", "state"), True),
    "QRDQN": (REPLAY, ("pixels", "both", "state"), True),
    "RecurrentPPO": (ROLLOUTS | {"batch_size": 8}, ("pixels", "both", "state"), False),
    "TQC": (REPLAY, ("pixels", "both", "state"), False),
    "TRPO": (ROLLOUTS | {"batch_size": 8}, ("pixels", "both", "state"), False),
}
NO_ALGORITHMS = {
    "HerReplayBuffer": "wants tasks with goals",
    "get_system_info": "a function",
}
POLICIES = {"pixels": "Cnn", "both": "MultiInput", "state": "Mlp"}

CASES = [(name, obs) for name, (_, many, _) in ALGORITHMS.items() for obs in many]


def test_there_is_a_case_for_every_algorithm():
    assert {*stable_baselines3.__all__, *sb3_contrib.__all__} == {*ALGORITHMS, *NO_ALGORITHMS}


def algorithm(name):
    return getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)


class Witness(VecEnvWrapper):
    """Keeps a copy of all that the environment hands out."""

    def __init__(self, venv):
        super().__init__(venv)
        self.first, self.actions, self.steps = None, [], []

    def reset(self):
        obs = self.venv.reset()
        self.first = copies(obs)
        return obs

    def step_async(self, actions):
        self.actions.append(actions.copy())
        self.venv.step_async(actions)

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        last = [
            copies(info["terminal_observation"]) if done else row(obs, i)
            for i, (done, info) in enumerate(zip(dones, infos, strict=True))
        ]
        self.steps.append((copies(obs), rewards.copy(), dones.copy(), last))
        return obs, rewards, dones, infos


def copies(obs):
    """Each part of an observation, without its name if it has none."""
    parts = obs if isinstance(obs, dict) else {"": obs}
    return {name: np.array(part) for name, part in parts.items()}


def row(obs, i):
    return {name: part[i] for name, part in copies(obs).items()}


class Rollouts(BaseCallback):
    """Keeps a copy of each rollout."""

    def _init_callback(self):
        self.kept = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = getattr(self.model, "rollout_buffer", None)
        if buffer is not None:
            self.kept.append((copies(buffer.observations), buffer.rewards.copy()))


def as_stored(part):
    """Images are kept channels first."""
    return part.transpose(0, 3, 1, 2) if part.ndim == 4 else part


def make_env(name, obs_mode):
    """What the algorithm gets, around the witness where actions are no numbers."""
    if not ALGORITHMS[name][2]:
        return Witness(SB3VecEnv(TASK, NUM_ENVS, obs_mode=obs_mode, **OPTIONS))

    def make_discrete():
        return WithMasks(DiscretizeAction(make(**OPTIONS, obs_mode=obs_mode), 3))

    return Witness(make_vec_env(make_discrete, NUM_ENVS))


class WithMasks(gymnasium.Wrapper):
    """Forbids the last action, for MaskablePPO."""

    def action_masks(self):
        return np.array([True, True, False])


@pytest.mark.parametrize(("name", "obs_mode"), CASES)
def test_learns_from_what_the_environment_hands_out(name, obs_mode):
    options, _, _ = ALGORITHMS[name]
    env = make_env(name, obs_mode)
    env.seed(0)
    policy = POLICIES[obs_mode] + ("LstmPolicy" if name == "RecurrentPPO" else "Policy")
    model = algorithm(name)(policy, env, seed=0, device="cpu", **deepcopy(options))
    before = [p.detach().clone() for p in model.policy.parameters()]
    rollouts = Rollouts()
    model.learn(128, callback=rollouts)
    after = list(model.policy.parameters())
    assert all(p.isfinite().all() for p in after)
    assert any((p != q).any() for p, q in zip(after, before, strict=True))

    stored, rewards = stored_by(model, rollouts)
    seen = [env.first] + [obs for obs, *_ in env.steps]
    for part, kept in stored.items():
        expected = [as_stored(obs[part]) for obs in seen[: len(kept)]]
        # A2C's rollouts and the others' are float32, which holds every color.
        assert_array_equal(kept, expected)
    # On-policy algorithms add the value of the last state where a time limit ends an episode.
    for kept, (_, paid, dones, _) in zip(rewards, env.steps, strict=False):
        assert_array_equal(kept[~dones], paid[~dones])
    assert any(dones.any() for _, _, dones, _ in env.steps)

    if hasattr(model, "replay_buffer"):
        count = model.replay_buffer.pos
        nexts = model.replay_buffer.next_observations
        for part, kept in (nexts if isinstance(nexts, dict) else {"": nexts}).items():
            for t in range(count):
                last = np.stack([ends[part] for ends in env.steps[t][3]])
                assert_array_equal(kept[t], as_stored(last))


def stored_by(model, rollouts):
    """Observations and rewards that the algorithm has learned from, in order."""
    if hasattr(model, "replay_buffer"):
        buffer, count = model.replay_buffer, model.replay_buffer.pos
        assert count * NUM_ENVS == 128
        obs = {name: part[:count] for name, part in copies(buffer.observations).items()}
        return obs, buffer.rewards[:count]
    if not rollouts.kept:  # ARS keeps no observations
        return {}, []
    many, rewards = zip(*rollouts.kept, strict=True)
    obs = {name: np.concatenate([part[name] for part in many]) for name in many[0]}
    assert all(len(part) * NUM_ENVS == 128 for part in obs.values())
    return obs, np.concatenate(rewards)


def test_a_masked_action_is_never_taken():
    env = make_env("MaskablePPO", "state")
    sb3_contrib.MaskablePPO("MlpPolicy", env, n_steps=16, batch_size=8, device="cpu").learn(64)
    assert set(np.ravel(env.actions)) == {0, 1}


def test_what_the_policy_earns_is_what_the_environment_pays():
    env = Witness(SB3VecEnv(TASK, NUM_ENVS, obs_mode="state", **OPTIONS))
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu")
    # It warns that nobody watches the episodes; the witness does.
    with pytest.warns(UserWarning, match="Monitor"):
        returns, lengths = evaluate_policy(
            model, env, n_eval_episodes=4, return_episode_rewards=True
        )
    assert lengths == [6] * 4
    paid = np.array([rewards for _, rewards, _, _ in env.steps])
    expected = paid.reshape(-1, 6, NUM_ENVS).sum(axis=1).ravel()
    np.testing.assert_allclose(returns, expected, rtol=1e-5)


def test_the_checker_is_content():
    check_env(
        make(**OPTIONS, render_mode="rgb_array").unwrapped, warn=False, skip_render_check=False
    )
    # Its advice is heeded as well: no warning.
    check_env(make(**OPTIONS).unwrapped)


@pytest.mark.parametrize("kind", ["dummy", "spawn"])
def test_environments_of_stable_baselines_hand_out_the_same(kind):
    if kind == "dummy":
        env = make_vec_env(ID, NUM_ENVS, env_kwargs=OPTIONS, vec_env_cls=DummyVecEnv)
    else:
        env = make_vec_env(
            ID,
            NUM_ENVS,
            env_kwargs=OPTIONS,
            vec_env_cls=SubprocVecEnv,
            vec_env_kwargs={"start_method": "spawn"},
        )
    ours = SB3VecEnv(TASK, NUM_ENVS, **OPTIONS)
    env.seed(3), ours.seed(3)
    assert_same_images(env.reset(), ours.reset())
    for action in ACTIONS[:8]:
        obs, rewards, dones, infos = env.step(np.stack([action, -action]))
        expected = ours.step(np.stack([action, -action]))
        assert_same_images(obs, expected[0])
        np.testing.assert_allclose(rewards, expected[1], rtol=1e-6)
        assert_array_equal(dones, expected[2])
        for mine, theirs in zip(expected[3], infos, strict=True):
            assert mine["TimeLimit.truncated"] == theirs["TimeLimit.truncated"]
            if "terminal_observation" in mine:
                assert_same_images(mine["terminal_observation"], theirs["terminal_observation"])
    env.close()


def test_the_remaining_wrappers_hand_on_what_they_get():
    env = SB3VecEnv(TASK, NUM_ENVS, obs_mode="both", **OPTIONS)
    bare = SB3VecEnv(TASK, NUM_ENVS, obs_mode="both", **OPTIONS)
    wrapped = VecCheckNan(VecExtractDictObs(env, key="pixels"), raise_exception=True)
    env.seed(0), bare.seed(0)
    assert_array_equal(wrapped.reset(), bare.reset()["pixels"])
    for action in ACTIONS:
        actions = np.stack([action, -action])
        (obs, _, dones, infos), expected = wrapped.step(actions), bare.step(actions)
        assert_array_equal(obs, expected[0]["pixels"])
        for i in np.flatnonzero(dones):
            last = expected[3][i]["terminal_observation"]["pixels"]
            assert_array_equal(infos[i]["terminal_observation"], last)
    with pytest.raises(ValueError, match="nan"):
        wrapped.step(np.full((NUM_ENVS, 1), np.nan, np.float32))


def test_frames_in_torch_are_those_of_the_environment():
    env = Witness(SB3VecEnv(TASK, NUM_ENVS, **OPTIONS))
    model = stable_baselines3.PPO("CnnPolicy", env, n_steps=8, batch_size=8, device="cpu")
    tensor, _ = model.policy.obs_to_tensor(env.reset())
    assert tensor.dtype == torch.uint8
    assert_array_equal(tensor, as_stored(env.first[""]))
