"""A toy task for both Gymnasium adapters; real tasks are slow to compile."""

from __future__ import annotations

import os

# Before pygame is imported: windows of render_mode="human" need no screen.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import gymnasium
import pytest

import pixelbrax_gym
import pixelbrax_jax
from tests.envs.toy import PARAMS, Ball

TASK = "toy_ball"
ID = "PixelBrax/ToyBall-v0"
SIZE = {"height": 12, "width": 12, "frame_stack": 2, "episode_length": 6}


@pytest.fixture(scope="session", autouse=True)
def toy_ball():
    pixelbrax_jax.register(TASK, Ball, camera=PARAMS.rig)
    assert pixelbrax_gym.register(TASK) == ID


@pytest.fixture
def make_single():
    made = []

    def make(**options):
        made.append(pixelbrax_gym.GymnasiumEnv(TASK, **(SIZE | options)))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def make_vector():
    made = []

    def make(num_envs=3, **options):
        made.append(gymnasium.make_vec(ID, num_envs=num_envs, **(SIZE | options)))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def make_torchrl():
    made = []

    def make(num_envs=3, seed=0, **options):
        options = SIZE | {"episode_length": 20} | options
        made.append(pixelbrax_gym.TorchRLEnv(TASK, num_envs, **options))
        if seed is not None:
            made[-1].set_seed(seed)
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def make_sb3():
    made = []

    def make(num_envs=3, seed=0, **options):
        options = SIZE | {"episode_length": 20} | options
        made.append(pixelbrax_gym.SB3VecEnv(TASK, num_envs, **options))
        made[-1].seed(seed)
        return made[-1]

    yield make
    for env in made:
        env.close()
