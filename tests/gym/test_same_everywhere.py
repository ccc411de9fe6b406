"""The same seed and actions give the same frames through every adapter, from first to true last."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import pixelbrax_jax
from tests.gym.conftest import SIZE, TASK

ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)
"""The first environment reaches its time limit, the others end by themselves before."""

OPTIONS = {"episode_length": 20, "frame_stack": 2}
STEPS = 70


def copy(frame):
    """A NumPy array of its own, from any framework's."""
    return np.asarray(frame).copy()


class Episodes:
    """Frames of each environment, episode by episode."""

    def __init__(self, obs):
        self.rows = [[[copy(frame)]] for frame in obs]

    def goes_on(self, i, frame):
        self.rows[i][-1].append(copy(frame))

    def begins(self, i, frame):
        self.rows[i].append([copy(frame)])

    @property
    def complete(self):
        return [episodes[:-1] for episodes in self.rows]


def next_step(obs, step):
    episodes, ended = Episodes(obs), np.zeros(3, bool)
    for _ in range(STEPS):
        obs, terminated, truncated, _ = step()
        for i in range(3):
            (episodes.begins if ended[i] else episodes.goes_on)(i, obs[i])
        ended = np.asarray(terminated) | np.asarray(truncated)
    return episodes.complete


def same_step(obs, step):
    episodes = Episodes(obs)
    for _ in range(STEPS):
        obs, terminated, truncated, final = step()
        ended = np.asarray(terminated) | np.asarray(truncated)
        for i in range(3):
            episodes.goes_on(i, final[i] if ended[i] else obs[i])
            if ended[i]:
                episodes.begins(i, obs[i])
    return episodes.complete


def through_jax(mode):
    env, params = pixelbrax_jax.make(TASK, **(SIZE | OPTIONS))
    envs = pixelbrax_jax.VectorPixelEnv(env, 3, mode)
    state, timestep = envs.reset(jax.vmap(jax.random.key)(jnp.arange(3)), params)
    carry = [state]

    def step():
        carry[0], timestep = envs.step(carry[0], ACTIONS, params)
        final = timestep.info.get("final_obs")
        return timestep.obs, timestep.terminated, timestep.truncated, final

    return (next_step if mode == "next_step" else same_step)(timestep.obs, step)


def through_gymnasium(make_vector, mode, output):
    envs = make_vector(autoreset_mode=mode, output=output, **OPTIONS)
    obs, _ = envs.reset(seed=0)

    def step():
        obs, _, terminated, truncated, info = envs.step(ACTIONS)
        return obs, terminated, truncated, info.get("final_obs")

    if mode != "disabled":
        return (next_step if mode == "next_step" else same_step)(obs, step)
    episodes = Episodes(obs)
    for _ in range(STEPS):
        obs, terminated, truncated, _ = step()
        for i in range(3):
            episodes.goes_on(i, obs[i])
        ended = np.asarray(terminated | truncated)
        if ended.any():
            obs, _ = envs.reset(options={"reset_mask": ended})
            for i in np.flatnonzero(ended):
                episodes.begins(i, obs[i])
    return episodes.complete


def through_torchrl(make_torchrl):
    env = make_torchrl(**OPTIONS)
    carry = [env.reset()]
    first = carry[0]["pixels"].clone()

    def step():
        td = carry[0].set("action", torch.from_numpy(ACTIONS))
        stepped, carry[0] = env.step_and_maybe_reset(td)
        ended = stepped["next"]
        flags = [ended[name].flatten().numpy() for name in ("terminated", "truncated")]
        return carry[0]["pixels"], *flags, ended["pixels"]

    return same_step(first, step)


def through_sb3(make_sb3):
    env = make_sb3(**OPTIONS)

    def step():
        obs, _, dones, infos = env.step(ACTIONS)
        return obs, dones, dones, [info.get("terminal_observation") for info in infos]

    return same_step(env.reset(), step)


@pytest.fixture(scope="module")
def expected():
    return through_jax("next_step")


def check(actual, expected):
    for ours, theirs in zip(actual, expected, strict=True):
        shared = min(len(ours), len(theirs))
        assert shared >= 3, "several episodes are compared"
        for one, other in zip(ours[:shared], theirs[:shared], strict=True):
            np.testing.assert_array_equal(one, other)


def test_episodes_are_of_all_kinds(expected):
    lengths = [[len(episode) for episode in episodes] for episodes in expected]
    assert set(lengths[0]) == {21}, "a first frame and twenty more"
    assert all(length < 21 for length in lengths[1] + lengths[2])


def test_jax_same_step(expected):
    check(through_jax("same_step"), expected)


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_gymnasium(make_vector, mode, output, expected):
    check(through_gymnasium(make_vector, mode, output), expected)


def test_torchrl(make_torchrl, expected):
    check(through_torchrl(make_torchrl), expected)


def test_sb3(make_sb3, expected):
    check(through_sb3(make_sb3), expected)
