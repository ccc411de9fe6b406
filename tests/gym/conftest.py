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


def maker(build):
    """A fixture: a function that makes environments, which are closed after the test."""

    @pytest.fixture
    def make():
        made = []

        def one(*args, **options):
            made.append(build(*args, **options))
            return made[-1]

        yield one
        for env in made:
            env.close()

    return make


def seeded(env, seed):
    if seed is not None:
        (env.set_seed if hasattr(env, "set_seed") else env.seed)(seed)
    return env


def torchrl(num_envs=3, seed=0, **options):
    options = SIZE | {"episode_length": 20} | options
    return seeded(pixelbrax_gym.TorchRLEnv(TASK, num_envs, **options), seed)


def sb3(num_envs=3, seed=0, **options):
    options = SIZE | {"episode_length": 20} | options
    return seeded(pixelbrax_gym.SB3VecEnv(TASK, num_envs, **options), seed)


def vector(num_envs=3, **options):
    return gymnasium.make_vec(ID, num_envs=num_envs, **(SIZE | options))


make_single = maker(lambda **options: pixelbrax_gym.GymnasiumEnv(TASK, **(SIZE | options)))
make_vector, make_torchrl, make_sb3 = maker(vector), maker(torchrl), maker(sb3)
