"""check_vector_env accepts sound environments and names what is wrong with others."""

from __future__ import annotations

import re

import gymnasium
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pixelbrax_gym import check_vector_env
from pixelbrax_gym.gymnasium.check import VectorEnvError, VectorEnvWarning
from tests.gym.numpy_env import CountingVectorEnv

NEXT, SAME, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
CHANGED_OPTIONS = "reset() changed the caller's options"


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_sound_environment_passes(mode, num_envs):
    check_vector_env(CountingVectorEnv(mode, num_envs=num_envs), num_steps=20)


@pytest.mark.parametrize("mode", [NEXT, SAME])
def test_gymnasiums_own_passes(mode):
    makers = [lambda: gymnasium.make("CartPole-v1")] * 3
    check_vector_env(SyncVectorEnv(makers, autoreset_mode=mode))


def test_gymnasiums_own_changes_options():
    makers = [lambda: gymnasium.make("CartPole-v1")] * 3
    with pytest.warns(VectorEnvWarning, match=re.escape(CHANGED_OPTIONS)):
        check_vector_env(SyncVectorEnv(makers, autoreset_mode=DISABLED))


FAULTS = {
    "no mode": (NEXT, "metadata['autoreset_mode'] must be an AutoresetMode, is None"),
    "mode as text": (NEXT, "must be an AutoresetMode, is 'NextStep'"),
    "two modes": (NEXT, "must agree with the metadata"),
    "observation space": (NEXT, "observation_space must be single_observation_space"),
    "bounds": (NEXT, "observation_space must be single_observation_space"),
    "action space": (NEXT, "action_space must be single_action_space"),
    "unseeded": (NEXT, "the same seed and actions must give the same results"),
    "dtype": (NEXT, "the observation of reset() must be float64 of shape (3, 2), is float32"),
    "shape": (NEXT, "the observation of reset() must be float64 of shape (3, 2)"),
    "outside": (NEXT, "the observation of reset() must lie in Box"),
    "reuses memory": (NEXT, "must not be overwritten by a later one"),
    "no mask": (NEXT, "infos['count'] must have a mask infos['_count']"),
    "mask dtype": (NEXT, "infos['_count'] must be bools of shape (3,)"),
    "info length": (NEXT, "infos['count'] must have 3 entries"),
    "infos type": (NEXT, "the infos of reset() must be a dict"),
    "reward of a reset": (NEXT, "after the end of an episode must return reward 0"),
    "flags of a reset": (NEXT, "after the end of an episode must return both flags False"),
    "no final_obs": (SAME, "infos must have 'final_obs' exactly where an episode ended"),
    "no final_info": (SAME, "infos must have 'final_info' exactly where an episode ended"),
    "final mask": (SAME, "infos must have 'final_obs' exactly where an episode ended"),
    "final_obs outside": (SAME, "infos['final_obs'][0] must lie in Box"),
    "never resets": (SAME, "the observation at the end of an episode must be the next one's"),
    "resets all": (DISABLED, "return the observations of the other environments as they were"),
    "resets others secretly": (DISABLED, "must leave the other environments alone"),
    "ignores mask": (DISABLED, "reset the masked environments"),
    "writes mask": (DISABLED, "must not write to the mask"),
    "reward dtype": (NEXT, "rewards must be floats of shape (3,), are int64"),
    "reward shape": (NEXT, "rewards must be floats of shape (3,), are float64 of shape (3, 1)"),
    "reward nan": (NEXT, "rewards must be finite"),
    "flag dtype": (NEXT, "truncated must be bools of shape (3,), is int64"),
    "four results": (NEXT, "step() must return observations, rewards, terminated, truncated"),
    "image array": (NEXT, "render() must return a tuple of 3, returned ndarray"),
    "image dtype": (NEXT, "render() must return uint8 NumPy arrays"),
    "closes once": (NEXT, "close() must work twice, but raised RuntimeError"),
    "stays open": (NEXT, "the attribute closed must be True after close()"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_environment_is_caught(fault):
    mode, rule = FAULTS[fault]
    with pytest.raises(VectorEnvError, match=re.escape(rule)):
        check_vector_env(CountingVectorEnv(mode, fault), num_steps=20)


def test_changed_options_are_a_warning():
    with pytest.warns(VectorEnvWarning, match=re.escape(CHANGED_OPTIONS)):
        check_vector_env(CountingVectorEnv(DISABLED, "options"), num_steps=20)


def test_too_few_steps_are_a_warning():
    with pytest.warns(VectorEnvWarning, match="no episode ended within 2 steps"):
        check_vector_env(CountingVectorEnv(NEXT), num_steps=2)


def test_a_single_environment_is_refused():
    with pytest.raises(VectorEnvError, match="must be a gymnasium VectorEnv"):
        check_vector_env(gymnasium.make("CartPole-v1"))
