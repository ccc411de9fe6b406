"""Every checker is content with the tasks of the DM Control Suite."""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from torchrl.envs import check_env_specs

import pixelbrax_gym
import pixelbrax_jax
from pixelbrax_jax.tasks import DMC_TASKS, TASKS
from tests.distractors.conftest import make_bank
from tests.gym.test_vector_env import MODES

pytest.importorskip("dm_control", reason="the tasks' models come with pixelbrax[dmc]")

SIZE = {"height": 36, "width": 36}  # Stable-Baselines3 warns of smaller ones
ENV = SIZE | {"engine": "mujoco"}  # MuJoCo XLA compiles for longer
RENDER = {"render_mode": "rgb_array", "render_height": 8, "render_width": 8}
FAST = "dmc_ball_in_cup_catch"
"""The task that stays among the fast tests."""


def among_slow(tasks):
    """Tasks as parameters; all but one are among the slow tests."""
    return [pytest.param(task, marks=() if task == FAST else pytest.mark.slow) for task in tasks]


EVERY_TASK = among_slow(pixelbrax_jax.list_envs(suite="dmc"))
ONE_OF_EVERY_DOMAIN = tuple({row.domain: task for task, row in DMC_TASKS.items()}.values())


@pytest.mark.parametrize("task", EVERY_TASK)
def test_our_own_checker(task):
    pixelbrax_jax.check_env(*pixelbrax_jax.make(task, obs_mode="both", **ENV))


@pytest.mark.parametrize("task", EVERY_TASK)
def test_checkers_of_single_environments(task):
    env = gymnasium.make(TASKS[task].gymnasium_id, **ENV, **RENDER).unwrapped
    check_gymnasium_env(env)
    check_sb3_env(env)


@pytest.mark.slow
@pytest.mark.parametrize("task", ONE_OF_EVERY_DOMAIN)
def test_checker_of_vector_environments(task):
    check_vector(task, "next_step")


@pytest.mark.slow
@pytest.mark.parametrize("mode", sorted(set(MODES) - {"next_step"}))
@pytest.mark.parametrize("task", [FAST, "dmc_cheetah_run"])
def test_checker_of_vector_environments_in_other_modes(task, mode):
    check_vector(task, mode)


def check_vector(task, mode):
    env = gymnasium.make_vec(
        TASKS[task].gymnasium_id,
        num_envs=2,
        obs_mode="both",  # at this size a reset may move less than a pixel
        max_episode_steps=6,
        autoreset_mode=mode,
        **ENV,
        **RENDER,
    )
    pixelbrax_gym.check_vector_env(env, num_steps=15)


# Programs of these two are the same.


@pytest.mark.slow
@pytest.mark.parametrize("task", ONE_OF_EVERY_DOMAIN)
def test_checker_of_torchrl(task):
    env = pixelbrax_gym.TorchRLEnv(task, 2, obs_mode="both", **ENV)
    check_env_specs(env)
    env.close()


@pytest.mark.parametrize("task", among_slow(ONE_OF_EVERY_DOMAIN))
def test_stable_baselines_vector_environments(task):
    env = pixelbrax_gym.SB3VecEnv(task, 2, obs_mode="both", episode_length=3, **ENV)
    env.seed(0)
    draw = np.random.default_rng(0)
    first = env.reset()
    for step in range(1, 5):
        obs, rewards, dones, infos = env.step(
            draw.uniform(-1, 1, (2, *env.action_space.shape)).astype(np.float32)
        )
        for index in range(2):
            assert {name: rows[index] for name, rows in obs.items()} in env.observation_space
        assert ((rewards >= 0) & (rewards <= 1)).all()
        # DM Control's episodes end at the time limit alone.
        assert list(dones) == [step == 3] * 2
        assert [info.get("TimeLimit.truncated", False) for info in infos] == list(dones)
    assert not np.array_equal(obs["state"], first["state"])
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("task", ONE_OF_EVERY_DOMAIN)
def test_distractors_change_pixels_alone(task):
    """The same episodes, to rounding: other options make another program."""
    options = {"num_envs": 2, "obs_mode": "both", "output": "torch", **ENV}
    make = functools.partial(gymnasium.make_vec, TASKS[task].gymnasium_id, **options)
    plain = make()
    chain = ("video", "color", "camera")
    distracted = make(distractors=chain, clips=make_bank(**SIZE))
    draw = np.random.default_rng(0)
    obs, seen = plain.reset(seed=0)[0], distracted.reset(seed=0)[0]
    for _ in range(4):
        assert (obs["pixels"] != seen["pixels"]).float().mean() > 0.5
        torch.testing.assert_close(obs["state"], seen["state"], rtol=1e-3, atol=1e-3)
        action = torch.as_tensor(draw.uniform(-1, 1, plain.action_space.shape).astype(np.float32))
        (obs, reward, *_), (seen, other, *_) = plain.step(action), distracted.step(action)
        torch.testing.assert_close(reward, other, rtol=1e-3, atol=1e-3)
