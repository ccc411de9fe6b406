"""Depth, segmentation and several cameras through every adapter."""

from __future__ import annotations

import copy
import pickle

import gymnasium
import jax
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from torchrl.envs import check_env_specs

import pixelbrax_gym
from pixelbrax_gym.torchrl.specs import PixelSpec
from tests.gym.conftest import ID, SIZE, TASK

IMAGES = "pixels+depth+segmentation"
SMALL = SIZE | {"frame_stack": 1}
CASES = [
    {"obs_mode": "depth"},
    {"obs_mode": f"{IMAGES}+state", "camera": ("default", "top")},
    {
        "obs_mode": "pixels+depth+state",
        "camera": ("default", "top"),
        "camera_sizes": {"default": (12, 12), "top": (9, 16)},
    },
]
ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)


@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is .?infinity")
@pytest.mark.parametrize("options", CASES)
def test_gymnasiums_checker(options):
    check_env(gymnasium.make(ID, **(SMALL | options)).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    "mode",
    [
        pytest.param("next_step", marks=pytest.mark.slow),
        "same_step",
        pytest.param("disabled", marks=pytest.mark.slow),
    ],
)
def test_our_checker_of_vector_environments(make_vector, mode):
    env = make_vector(autoreset_mode=mode, **(SMALL | CASES[1]))
    pixelbrax_gym.check_vector_env(env, num_steps=10)


def test_spaces(make_single):
    env = make_single(**(SMALL | CASES[1]))
    assert env.observation_space == Dict(
        {
            "pixels": Box(0, 255, (12, 12, 6), np.uint8),
            "depth": Box(0.0, 100.0, (12, 12, 2), np.float32),
            "segmentation": Box(-1, 2**31 - 1, (12, 12, 2), np.int32),
            "state": Box(-np.inf, np.inf, (2,), np.float32),
        }
    )
    assert make_single(obs_mode="depth").observation_space == Box(
        0.0, 100.0, (12, 12, 2), np.float32
    )


@pytest.mark.parametrize("options", CASES)
def test_torchrls_checker(make_torchrl, options):
    env = make_torchrl(**(SMALL | options))
    check_env_specs(env)
    depth = "depth/default" if "camera_sizes" in options else "depth"
    assert type(env.observation_spec[depth]) is PixelSpec
    td = env.rollout(3)
    assert td[depth].dtype == torch.float32
    if "camera_sizes" in options:
        assert td["pixels/top"].shape == (3, 3, 9, 16, 3)
    elif "camera" in options:
        assert td["segmentation"].dtype == torch.int32
        assert td["observation"].shape == (3, 3, 2)
        assert td["pixels"].shape == (3, 3, 12, 12, 6)


# Stable-Baselines3 advises against images that are not uint8, for which it has no layers.
@pytest.mark.filterwarnings("ignore:It seems that your observation.*is an image")
@pytest.mark.filterwarnings("ignore:The minimal resolution for an image")
@pytest.mark.parametrize("options", CASES)
def test_stable_baselines_checker(options):
    check_sb3_env(gymnasium.make(ID, **(SMALL | options)).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("sizes", [(), {"default": (36, 36), "top": (40, 48)}])
def test_stable_baselines_learns_from_several_images(sizes):
    env = pixelbrax_gym.SB3VecEnv(
        TASK, 2, obs_mode="pixels+depth", camera=("default", "top"),
        height=36, width=36, camera_sizes=sizes, frame_stack=1,
    )  # fmt: skip
    PPO("MultiInputPolicy", env, n_steps=4, batch_size=8, n_epochs=1, device="cpu").learn(8)


def test_channels_first_is_for_all_images(make_sb3):
    options = SMALL | CASES[1]
    env, plain = make_sb3(channels_first=True, **options), make_sb3(**options)
    obs, expected = env.reset(), plain.reset()
    for name, part in expected.items():
        moved = part if name == "state" else part.transpose(0, 3, 1, 2)
        np.testing.assert_array_equal(obs[name], moved)
        assert env.observation_space[name].contains(obs[name][0])


def test_two_cameras_count_as_channels(make_sb3):
    with pytest.raises(ValueError, match="height=12, width=12, 2 cameras and frame_stack=2"):
        make_sb3(camera=("default", "top"))
    with pytest.raises(ValueError, match=r"camera_sizes\['top'\]=\(5, 16\) and frame_stack=2"):
        make_sb3(camera=("default", "top"), camera_sizes={"default": (16, 16), "top": (5, 16)})


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_images_are_the_buffers_that_jax_computed(make_vector, output):
    env = make_vector(output=output, **(SMALL | CASES[1]))
    env.reset(seed=0)
    stateful, seen = env._stateful, []
    step = stateful.step
    stateful.step = lambda action: seen.append(step(action)) or seen[-1]
    obs = env.step(ACTIONS)[0]
    for name, part in obs.items():
        pointer = part.data_ptr() if output == "torch" else part.ctypes.data
        assert pointer == seen[0]["obs"][name].unsafe_buffer_pointer()
        part[...] = 0
    # What was written reaches no later observation.
    kept = jax.tree.map(lambda x: np.array(np.asarray(x)), env.step(ACTIONS)[0])
    env.reset(seed=0)
    env.step(ACTIONS)
    for name, part in env.step(ACTIONS)[0].items():
        np.testing.assert_array_equal(np.asarray(part), kept[name])


@pytest.mark.parametrize("num_envs", [3, pytest.param(33, marks=pytest.mark.slow)])
def test_states_and_copies_continue(num_envs):
    env = gymnasium.make_vec(ID, num_envs=num_envs, **(SMALL | CASES[1]))
    env.reset(seed=0)
    state = env.get_state()
    copied, unpickled = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    actions = np.full((num_envs, 1), 0.5, np.float32)
    expected = [env.step(actions)[0] for _ in range(8)]
    env.set_state(state)
    for one in (env, copied, unpickled):
        for obs in expected:
            jax.tree.map(np.testing.assert_array_equal, one.step(actions)[0], obs)
    one_camera = gymnasium.make_vec(ID, num_envs=num_envs, **SMALL)
    with pytest.raises(ValueError, match="number of cameras, names in camera_sizes and obs_mode"):
        one_camera.set_state(state)


@pytest.mark.parametrize("sizes", [(), {"default": (12, 12), "top": (9, 16)}])
def test_cameras_go_through_json(sizes):
    env = gymnasium.make(
        ID, camera=("default", "top"), camera_sizes=sizes, obs_mode="depth", **SMALL
    )
    spec = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
    again = gymnasium.make(spec)
    assert again.spec == env.spec
    assert again.observation_space == env.observation_space
