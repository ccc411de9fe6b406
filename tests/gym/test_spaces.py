"""Spaces are those that Gymnasium's own functions know, and take little memory."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Tuple
from gymnasium.vector.utils import batch_differing_spaces, batch_space, concatenate, iterate

from pixelbrax_gym import SB3VecEnv
from pixelbrax_gym.gymnasium.spaces import BroadcastBox, action_space, observation_space
from tests.gym.conftest import ID, SIZE, TASK


def boxes(space):
    return list(space.spaces.values()) if isinstance(space, Dict) else [space]


@pytest.mark.parametrize("obs_mode", ["pixels", "state", "both"])
def test_spaces_of_one_environment_are_plain_boxes(make_single, make_vector, obs_mode):
    env, envs = make_single(obs_mode=obs_mode), make_vector(obs_mode=obs_mode)
    spaces = [env.observation_space, env.action_space]
    spaces += [envs.single_observation_space, envs.single_action_space]
    sb3 = SB3VecEnv(TASK, 2, channels_first=True, obs_mode=obs_mode, **SIZE)
    spaces += [sb3.observation_space, sb3.action_space]
    for box in [box for space in spaces for box in boxes(space)]:
        assert type(box) is Box
        box.low[0] = 1
        assert (box.low[0] == 1).all()


@pytest.mark.parametrize("obs_mode", ["pixels", "state", "both"])
def test_vector_environments_of_differing_spaces(obs_mode):
    options = SIZE | {"obs_mode": obs_mode}
    make = lambda: gymnasium.make(ID, **options)  # noqa: E731
    env = gymnasium.vector.SyncVectorEnv([make, make], observation_mode="different")
    same = gymnasium.vector.SyncVectorEnv([make, make])
    assert env.observation_space == same.observation_space
    obs, expected = env.reset(seed=0)[0], same.reset(seed=0)[0]
    for name in obs if obs_mode == "both" else [...]:
        np.testing.assert_array_equal(obs[name], expected[name])


def test_batched_spaces_are_known_by_their_exact_class(make_vector):
    env = make_vector(obs_mode="both")
    both = Tuple((env.observation_space, env.action_space))
    sample = both.sample()
    items = list(iterate(both, sample))
    assert len(items) == 3
    for i, (obs, action) in enumerate(items):
        np.testing.assert_array_equal(obs["pixels"], sample[0]["pixels"][i])
        np.testing.assert_array_equal(action, sample[1][i])
    out = gymnasium.vector.utils.create_empty_array(env.single_observation_space, 3)
    again = concatenate(env.single_observation_space, [obs for obs, _ in items], out)
    np.testing.assert_array_equal(again["state"], sample[0]["state"])
    batched = batch_differing_spaces([env.action_space] * 2)
    assert batched == Box(-1, 1, (2, 3, 1), np.float32)


def test_a_batched_space_equals_gymnasiums():
    for single, ours in (
        (action_space(3), action_space(3, 5)),
        (Box(-np.inf, np.inf, (4,), np.float32), BroadcastBox(-np.inf, np.inf, (5, 4), np.float32)),
    ):
        assert batch_space(single, 5) == ours
        assert ours == batch_space(single, 5)
    assert action_space(3, 5) != action_space(3, 4)
    assert observation_space({}, 2) == Dict({})
