"""Our tasks of Gymnasium's do what Gymnasium's do, which is asked itself."""

from __future__ import annotations

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_gym  # noqa: F401
import pixelbrax_jax as pb
from pixelbrax_jax.physics.gym.tasks import TASKS
from pixelbrax_jax.registry import make_physics
from tests.physics.gym import measure


@pytest.mark.parametrize("task", TASKS)
def test_a_step_has_the_same_observation_reward_and_end(task):
    errors = measure.control_step(task, 1000)
    assert errors["flags_off"] == 0
    assert errors["observation"] < 1e-4
    assert errors["reward"] < 1e-5


@pytest.mark.parametrize("task", TASKS)
def test_sizes_and_times(task):
    physics = make_physics(task)
    env = gymnasium.make(TASKS[task].original)
    assert (physics.state_size,) == env.observation_space.shape
    assert (physics.action_size,) == env.action_space.shape
    assert physics.dt == pytest.approx(env.unwrapped.dt)
    assert physics.time_limit == env.spec.max_episode_steps
    reachable = None if task == "gym_pusher" else env.spec.reward_threshold
    assert TASKS[task].success_return == reachable
    low, high = (physics.control(jnp.full(physics.action_size, end)) for end in (-1.0, 1.0))
    np.testing.assert_allclose(low, env.action_space.low)
    np.testing.assert_allclose(high, env.action_space.high)
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_initial_states_have_the_same_distribution(task):
    p_values = measure.initial_states(task, 300)
    low = [name for name, p in p_values.items() if not p > 0.01]
    if low:
        # One of a hundred is that low by chance; of another sample none may be.
        again = measure.initial_states(task, 300, seed=1)
        assert {name: again[name] for name in low if not again[name] > 0.01} == {}


def test_the_shorter_time_limit_holds():
    options = {"height": 8, "width": 8}
    assert pb.make("gym_reacher", **options)[1].episode_length == 50
    assert pb.make("gym_reacher", **options, episode_length=7)[1].episode_length == 7
    env = gymnasium.make("PixelBrax/Gym-Reacher-v5", **options)
    assert env.spec.max_episode_steps == 50


@pytest.mark.parametrize("name", ["Ant-v5", "gym-ant", "PixelBrax/Gym-Ant-v5"])
def test_gymnasiums_names_are_understood(name):
    with pytest.raises(ValueError, match=r"Did you mean 'gym_ant'\?"):
        pb.make(name)
