"""States that are taken from an environment and given back."""

from __future__ import annotations

import pickle

import jax
import numpy as np
import pytest
from gymnasium import error

import pixelbrax_jax
from tests.gym.conftest import TASK

ACTION = np.array([0.7], np.float32)
ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)


def equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_single_environment_goes_back(make_single):
    env = make_single(obs_mode="both")
    env.reset(seed=5)
    env.step(ACTION)
    state = pickle.loads(pickle.dumps(env.get_state()))
    first = [env.step(ACTION) for _ in range(5)]
    _, info = env.reset(options={"state": state})
    assert info["episode_length"] == 1
    equal([env.step(ACTION) for _ in range(5)], first)
    # Into an ended episode's place, and by another environment.
    other = make_single(obs_mode="both")
    other.set_state(state)
    equal([other.step(ACTION) for _ in range(5)], first)
    equal(other.reset(), env.reset())


def test_a_state_of_the_functional_environment(make_single):
    env = make_single(obs_mode="both")
    functional, params = env._stateful.env, env._stateful.params
    state, timestep = functional.reset(jax.random.key(9), params)
    obs, _ = env.reset(options={"state": state})
    equal(obs, timestep.obs)
    equal(obs, make_single(obs_mode="both").reset(seed=9)[0])
    equal(jax.tree.map(jax.numpy.asarray, env.get_state().sim), state.sim)


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_many_environments_go_back(make_vector, mode):
    env = make_vector(obs_mode="both", autoreset_mode=mode)
    env.reset(seed=5)
    for _ in range(3):
        env.step(ACTIONS)
    state = env.get_state()
    first = [env.step(ACTIONS)[:4] for _ in range(3)]
    env.reset(options={"state": state})
    equal([env.step(ACTIONS)[:4] for _ in range(3)], first)


def test_some_environments_go_back(make_vector):
    env = make_vector(obs_mode="both")
    env.reset(seed=5)
    start = env.get_state()
    for _ in range(2):
        env.step(ACTIONS)
    before = env.get_state()
    mask = np.array([True, False, True])
    _, info = env.reset(options={"state": start, "reset_mask": mask})
    np.testing.assert_array_equal(info["_episode_length"], mask)
    np.testing.assert_array_equal(info["episode_length"], [0, 2, 0])
    after = env.get_state()
    np.testing.assert_array_equal(after.sim.step_count, [0, 2, 0])
    np.testing.assert_array_equal(after.frames[1], before.frames[1])
    np.testing.assert_array_equal(after.frames[mask], start.frames[mask])


def test_a_state_stays_as_it_is(make_vector):
    env = make_vector(output="torch")
    env.reset(seed=5)
    state = env.get_state()
    frames = np.array(state.frames)
    for _ in range(4):
        env.step(ACTIONS)[0].fill_(7)
    np.testing.assert_array_equal(state.frames, frames)


def test_what_is_refused(make_single, make_vector):
    env = make_single()
    with pytest.raises(error.ResetNeeded, match=r"reset\(\) before get_state"):
        env.get_state()
    env.reset(seed=0)
    state = env.get_state()
    with pytest.raises(TypeError, match="must be an EnvState from get_state"):
        env.set_state({"frames": state.frames})
    with pytest.raises(TypeError, match=r"must be an EnvState of get_state\(\), got None"):
        env.reset(options={"state": None})
    with pytest.raises(ValueError, match=r"takes a seed or options\['state'\], got both"):
        env.reset(seed=1, options={"state": state})
    with pytest.raises(ValueError, match=r"state\.frames must be uint8 of shape \(3, 12, 12, 6\)"):
        make_vector().set_state(
            jax.tree.map(lambda x: jax.numpy.stack([x] * 3), state).replace(
                frames=np.zeros((3, 13, 12, 6), np.uint8)
            )
        )
    with pytest.raises(ValueError, match="does not have the structure"):
        make_single(distractors="color").set_state(state)
    with pytest.raises(ValueError, match="Allowed: reset_mask, state"):
        make_vector().reset(options={"mask": 1})
    # The first one stays usable after each.
    env.step(ACTION)
    pixelbrax_jax.make(TASK)
