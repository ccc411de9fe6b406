"""Ids, options and time limits, through gymnasium.make and make_vec."""

from __future__ import annotations

import pickle

import gymnasium
import numpy as np
import pytest

import pixelbrax_gym
import pixelbrax_jax
from pixelbrax_jax import registry
from tests.gym.conftest import ID, SIZE, TASK

TASKS = {
    "Ant": "ant",
    "HalfCheetah": "halfcheetah",
    "Hopper": "hopper",
    "Humanoid": "humanoid",
    "HumanoidStandup": "humanoidstandup",
    "InvertedPendulum": "inverted_pendulum",
    "InvertedDoublePendulum": "inverted_double_pendulum",
    "Pusher": "pusher",
    "Reacher": "reacher",
    "Swimmer": "swimmer",
    "Walker2d": "walker2d",
}


def test_the_eleven_ids():
    for name, task in TASKS.items():
        spec = gymnasium.spec(f"PixelBrax/{name}-v0")
        assert spec.kwargs == {"task": task}
        assert task in pixelbrax_jax.list_envs()


def test_lazy_names():
    assert issubclass(pixelbrax_gym.GymnasiumEnv, gymnasium.Env)
    assert issubclass(pixelbrax_gym.GymnasiumVectorEnv, gymnasium.vector.VectorEnv)
    assert callable(pixelbrax_gym.check_vector_env)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = pixelbrax_gym.nothing


def test_register_rejects_unknown_tasks_and_taken_ids(monkeypatch):
    with pytest.raises(ValueError, match=r"unknown task: 'toy_bal'.*Did you mean 'toy_ball'"):
        pixelbrax_gym.register("toy_bal")
    with pytest.raises(ValueError, match="'PixelBrax/Ant-v0' is already registered"):
        pixelbrax_gym.register(TASK, "PixelBrax/Ant-v0")
    assert pixelbrax_gym.register(TASK) == ID, "once more"
    assert pixelbrax_gym.register(TASK, "Mine/Ball-v3") == "Mine/Ball-v3"
    monkeypatch.setitem(registry._OWN_TASKS, "glass arm/2", registry._OWN_TASKS[TASK])
    assert pixelbrax_gym.register("glass arm/2") == "PixelBrax/GlassArm2-v0"
    assert gymnasium.spec("Mine/Ball-v3").kwargs == {"task": TASK}


def test_make_keeps_its_options_through_a_pickled_spec():
    env = gymnasium.make(ID, **SIZE, obs_mode="both", render_mode="rgb_array", render_height=7)
    again = gymnasium.make(pickle.loads(pickle.dumps(env.spec)))
    assert again.spec == env.spec
    assert again.observation_space == env.observation_space
    again.reset(seed=0)
    assert again.render().shape == (7, 480, 3)


def test_make_vec_keeps_its_options_through_a_pickled_spec():
    env = gymnasium.make_vec(ID, num_envs=2, **SIZE, autoreset_mode="same_step")
    again = gymnasium.make_vec(pickle.loads(pickle.dumps(env.spec)))
    assert again.num_envs == 2
    assert again.autoreset_mode is gymnasium.vector.AutoresetMode.SAME_STEP
    assert again.observation_space == env.observation_space


def steps_until_truncated(env, at_most: int = 99) -> int:
    env.reset(seed=0)
    action = np.full(env.action_space.shape, -0.1, np.float32)
    for count in range(1, at_most + 1):
        _, _, terminated, truncated, _ = env.step(action)
        assert not np.any(terminated)
        if np.all(truncated):
            return count
    raise AssertionError("never truncated")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"episode_length": 6}, 6),
        ({"episode_length": 6, "action_repeat": 2}, 3),
        ({"max_episode_steps": 4}, 4),
        ({"max_episode_steps": 4, "action_repeat": 2}, 4),
    ],
)
@pytest.mark.parametrize("adapter", ["make", "vector", "sync"])
def test_time_limits_mean_the_same_at_every_door(adapter, options, expected):
    options = {"obs_mode": "state"} | options
    if adapter == "make":
        env = gymnasium.make(ID, **options)
    else:
        mode = "sync" if adapter == "sync" else None
        env = gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, **options)
    assert steps_until_truncated(env) == expected


def test_minus_one_keeps_the_time_limit_of_the_environment():
    options = {"obs_mode": "state", "episode_length": 6, "max_episode_steps": -1}
    assert steps_until_truncated(gymnasium.make(ID, **options)) == 6
    assert steps_until_truncated(gymnasium.make_vec(ID, num_envs=2, **options)) == 6


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_time_limit_that_no_episode_reaches(make):
    env = make(ID, obs_mode="state", action_repeat=2, max_episode_steps=10**10)
    env.reset(seed=0)
    assert not np.any(env.step(env.action_space.sample())[3])


@pytest.mark.parametrize(("calls", "length", "expected"), [(3, 9, 3), (7, 9, 5), (5, 9, 5)])
def test_of_two_time_limits_the_first_one_holds(calls, length, expected):
    options = {"obs_mode": "state", "action_repeat": 2}
    options |= {"max_episode_steps": calls, "episode_length": length}
    assert steps_until_truncated(gymnasium.make(ID, **options)) == expected
    assert steps_until_truncated(gymnasium.make_vec(ID, num_envs=2, **options)) == expected


@pytest.mark.parametrize(
    ("first", "changes", "expected"),
    [
        ({"max_episode_steps": 3}, {}, 3),
        ({}, {"max_episode_steps": 5}, 5),
        ({}, {"episode_length": 5}, 5),
        ({"episode_length": 8}, {"action_repeat": 3}, 3),
        ({"max_episode_steps": 8, "action_repeat": 3}, {"max_episode_steps": 2}, 2),
    ],
)
@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_time_limits_of_environments_made_from_a_spec(make, first, changes, expected):
    spec = make(ID, obs_mode="state", **first).spec
    remade = gymnasium.make_vec(spec, num_envs=2, **changes)
    assert steps_until_truncated(remade) == expected
    assert remade.spec.max_episode_steps == expected
    if make is gymnasium.make:
        assert steps_until_truncated(gymnasium.make(spec, **changes)) == expected


@pytest.mark.parametrize(
    ("options", "expected"),
    [({}, 1000), ({"action_repeat": 3}, 334), ({"episode_length": 7, "action_repeat": 2}, 4)],
)
def test_specs_tell_the_time_limit(options, expected):
    options = {"obs_mode": "state"} | options
    for env, remake in (
        (gymnasium.make(ID, **options), gymnasium.make),
        (gymnasium.make_vec(ID, num_envs=2, **options), gymnasium.make_vec),
    ):
        assert env.spec.max_episode_steps == expected
        again = remake(env.spec)
        assert again.spec == env.spec
        limit = again.unwrapped._stateful.episode_length
        assert limit == env.unwrapped._stateful.episode_length


def test_spaces_cost_nothing_and_print_fast():
    env = pixelbrax_gym.GymnasiumVectorEnv(TASK, 4096)
    assert env.observation_space.shape == (4096, 84, 84, 9)
    assert env.observation_space.low.strides == (0, 0, 0, 0)
    assert repr(env.observation_space) == "Box(0, 255, (4096, 84, 84, 9), uint8)"
    assert len(pickle.dumps(env.observation_space)) < 5000
    copy = pickle.loads(pickle.dumps(env.observation_space))
    assert copy == env.observation_space
    assert copy.low.strides == (0, 0, 0, 0)
