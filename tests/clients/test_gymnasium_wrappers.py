"""Every wrapper of Gymnasium for one environment does what it says on ours."""

from __future__ import annotations

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pygame
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_allclose, assert_array_equal

from tests.clients.ball import ACTIONS, LIMIT, frames_of, make, play
from tests.clients.wrapper_cases import CHANGES, PICTURES, UNSEEN, cases, moments, same

CASES, case = cases()
close = partial(assert_allclose, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in wrappers.__all__ if name != "vector"])
def test_wrapper(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if name in CHANGES:
        wrap, *changes, obs_mode = CHANGES[name]
        compare(wrap(wrappers, make(obs_mode=obs_mode)), *changes, obs_mode=obs_mode)
        return
    assert name in CASES, f"Gymnasium has a new wrapper, {name}: write a case for it"
    CASES[name](getattr(wrappers, name))


def test_no_case_is_of_a_wrapper_that_is_gone():
    assert {*CASES, *CHANGES} <= set(wrappers.__all__)


def compare(wrapped, obs=same, reward=same, action=same, **options):
    """Asserts that a wrapper changes these things in this way, and nothing else."""
    plain = play(make(**options), [action(a) for a in ACTIONS[:LIMIT]])
    steps = play(wrapped, ACTIONS[:LIMIT])
    assert len(steps.obs) == LIMIT + 1
    for mine, theirs in zip(plain.obs, steps.obs, strict=True):
        expected = obs(mine)
        assert theirs in wrapped.observation_space
        jax.tree.map(close, theirs, expected)
        jax.tree.map(lambda x, y: x.dtype == y.dtype or pytest.fail(x.dtype), theirs, expected)
    assert_allclose(steps.rewards, [reward(r) for r in plain.rewards], rtol=1e-6)
    assert steps.terminated == plain.terminated
    assert steps.truncated == plain.truncated == [False] * (LIMIT - 1) + [True]


@case("AtariPreprocessing")
def needs_the_emulator_of_atari(wrapper):
    env = wrapper(make(), noop_max=0, frame_skip=1)
    with pytest.raises(AttributeError, match="ale"):
        env.reset(seed=0)


@case("DelayObservation")
def shows_what_was_two_steps_ago(wrapper):
    plain, steps = play(make(), ACTIONS[:6]), play(wrapper(make(), delay=2), ACTIONS[:6])
    for t in (0, 1):
        assert not steps.obs[t].any()
    assert_array_equal(steps.obs[2:], plain.obs[:-2])


@case("DiscretizeObservation")
def shows_four_levels_of_each_color(wrapper):
    # Edges at 63.75, 127.5 and 191.25: above an edge is a level more.
    compare(
        wrapper(make(), bins=4, multidiscrete=True),
        obs=lambda pixels: np.int64(pixels.ravel() // 64),
    )


@case("FrameStackObservation")
def stacks_on_a_new_axis_beginning_with_black(wrapper):
    plain = play(make(), ACTIONS[:6]).obs
    black = np.zeros_like(plain[0])
    for t, obs in enumerate(play(wrapper(make(), 3, padding_type="zero"), ACTIONS[:6]).obs):
        assert_array_equal(obs, [black, black, *plain][t : t + 3])


@case("MaxAndSkipObservation")
def shows_the_brighter_of_two_frames(wrapper):
    plain = play(make(), ACTIONS[:1].repeat(6, axis=0))
    steps = play(wrapper(make(), skip=2), ACTIONS[:1].repeat(3, axis=0))
    for t in range(3):
        assert_array_equal(steps.obs[t + 1], np.maximum(*plain.obs[2 * t + 1 : 2 * t + 3]))
        assert steps.rewards[t] == pytest.approx(sum(plain.rewards[2 * t : 2 * t + 2]))
    assert steps.truncated == [False, False, True]


@case("NormalizeObservation")
def shows_deviations_from_the_mean_so_far(wrapper):
    plain, steps = play(make(**UNSEEN), ACTIONS[:6]), play(wrapper(make(**UNSEEN)), ACTIONS[:6])
    for t, obs in enumerate(steps.obs):
        seen = np.array(plain.obs[: t + 1], np.float64)
        mean, var = moments(seen)
        # float32 sums of seven numbers, divided by deviations of at least 0.01.
        assert_allclose(obs, (seen[-1] - mean) / np.sqrt(var + 1e-8), atol=1e-3)


@case("AddRenderObservation")
def shows_what_render_draws(wrapper):
    def wrapped():
        return wrapper(make(**UNSEEN, **PICTURES), render_only=False)

    bare, env = make(**UNSEEN, **PICTURES), wrapped()
    pairs = [(bare.reset(seed=0)[0], env.reset(seed=0)[0])]
    images = [bare.render()]
    for action in ACTIONS[:6]:
        pairs.append((bare.step(action)[0], env.step(action)[0]))
        images.append(bare.render())
    for (state, obs), image in zip(pairs, images, strict=True):
        assert_array_equal(obs["state"], state)
        assert_array_equal(obs["pixels"], image)
    assert (images[0] != images[1]).any(), "the ball moves"


@case("TimeAwareObservation")
def tells_the_part_of_the_time_that_has_passed(wrapper):
    for options, limit in (
        ({}, 6),
        ({"action_repeat": 2}, 3),
        ({"episode_length": 7, "action_repeat": 2}, 4),
    ):
        env = wrapper(make(**options), flatten=False, normalize_time=True)
        steps = play(env, ACTIONS[:limit])
        assert steps.truncated == [False] * (limit - 1) + [True]
        for t, obs in enumerate(steps.obs):
            assert obs["time"] == pytest.approx(t / limit)
    # Not told: 1000 control steps.
    env = wrapper(gymnasium.make(make().spec.id, obs_mode="state"), flatten=False)
    assert env.observation_space["time"].high == 1000


@case("DiscretizeAction")
def offers_four_forces(wrapper):
    env = wrapper(make(), bins=4)
    assert env.action_space == gymnasium.spaces.Discrete(4)
    numbers, forces = [0, 3, 1, 2, 3, 0], [-0.75, 0.75, -0.25, 0.25, 0.75, -0.75]
    plain = play(make(), np.array(forces, np.float32)[:, None])
    steps = play(env, numbers)
    assert_array_equal(steps.obs, plain.obs)
    assert steps.rewards == plain.rewards


@case("StickyAction")
def sticks_to_the_first_action(wrapper):
    compare(wrapper(make(), 1 - 1e-12), action=lambda action: ACTIONS[0])


@case("RepeatAction")
def acts_three_times(wrapper):
    plain = play(make(), ACTIONS[[0, 0, 0, 1, 1, 1]])
    steps = play(wrapper(make(), 3), ACTIONS[:2])
    assert_array_equal(steps.obs, plain.obs[::3])
    assert_allclose(steps.rewards, np.sum(np.reshape(plain.rewards, (2, 3)), axis=1), rtol=1e-6)
    assert steps.truncated == [False, True]


@case("NormalizeReward")
def pays_in_deviations_of_the_discounted_return(wrapper):
    plain, steps = play(make(), ACTIONS[:6]), play(wrapper(make(), gamma=0.5), ACTIONS[:6])
    returns = []
    for t in range(6):
        returns.append((0.5 * returns[-1] if returns else 0.0) + plain.rewards[t])
        _, var = moments(np.array(returns))
        assert steps.rewards[t] == pytest.approx(plain.rewards[t] / np.sqrt(var + 1e-8))


@case("TimeLimit")
def shortens_an_episode(wrapper):
    steps = play(wrapper(make(), 4), ACTIONS[:4])
    assert_array_equal(steps.obs, play(make(), ACTIONS[:4]).obs)
    assert steps.truncated == [False, False, False, True]


@case("Autoreset")
def begins_the_next_episode_by_itself(wrapper):
    env = make()
    first = play(env, ACTIONS[:6]).obs
    env = make()
    env.reset(seed=0)
    second, _ = env.reset()
    steps = play(wrapper(make()), ACTIONS[:8])
    assert_array_equal(steps.obs[:7], first)
    assert_array_equal(steps.obs[7], second)
    assert steps.rewards[6] == 0
    assert (second != first[0]).any()


@case("PassiveEnvChecker")
def has_no_complaints(wrapper):
    # Its complaints are warnings, which are errors here.
    for obs_mode in ("pixels", "state", "both"):
        env = make(obs_mode=obs_mode, **PICTURES)
        compare(wrapper(env.unwrapped), obs_mode=obs_mode)
        env = wrapper(make(obs_mode=obs_mode, **PICTURES).unwrapped)
        env.reset(seed=0)
        assert env.render().shape == (32, 32, 3)
    # The active checker is content too. It finds the bounds of the state too wide.
    check_env(make(**PICTURES).unwrapped, skip_render_check=False)


@case("OrderEnforcing")
def wants_a_reset_first(wrapper):
    for use in (lambda env: env.step(ACTIONS[0]), lambda env: env.render()):
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
            use(wrapper(make(**PICTURES).unwrapped))
    compare(wrapper(make().unwrapped))


@case("RecordEpisodeStatistics")
def sums_rewards(wrapper):
    env = wrapper(make())
    steps = play(env, ACTIONS[:6])
    assert steps.infos[-1]["episode"]["r"] == pytest.approx(sum(steps.rewards))
    assert steps.infos[-1]["episode_return"] == pytest.approx(sum(steps.rewards))
    assert list(env.length_queue) == [6]


@case("AddWhiteNoise")
def replaces_half_of_the_picture(wrapper):
    noisy, clean = pictures_of(wrapper(make(**PICTURES), 0.5)), pictures_of(make(**PICTURES))
    # 32 x 32 draws: the deviation of the mean is 0.016.
    assert 0.4 < (noisy != clean).any(axis=-1).mean() < 0.6


@case("ObstructView")
def replaces_patches_of_the_picture(wrapper):
    blocked, clean = pictures_of(wrapper(make(**PICTURES), 0.5, 4)), pictures_of(make(**PICTURES))
    # Half of it, were it not that patches overlap: 1 - exp(-1/2).
    assert 0.25 < (blocked != clean).any(axis=-1).mean() < 0.5


def pictures_of(env):
    env.reset(seed=0)
    env.np_random.random(), env.step(ACTIONS[0])
    return env.render()


@case("RenderCollection")
def keeps_a_picture_of_each_step(wrapper):
    env, bare = wrapper(make(**PICTURES)), make(**PICTURES)
    env.reset(seed=0), bare.reset(seed=0)
    expected = [bare.render()]
    for action in ACTIONS[:4]:
        env.step(action), bare.step(action)
        expected.append(bare.render())
    assert_array_equal(env.render(), expected)


@case("RecordVideo")
def films_a_picture_of_each_step(wrapper):
    expected = filmed(wrapper(make(**PICTURES), "videos", episode_trigger=lambda _: True))
    film = frames_of("videos/rl-video-episode-0.mp4")
    assert film.shape == (LIMIT + 1, 32, 32, 3)
    # The codec loses a little.
    assert np.abs(film.astype(float) - expected).mean() < 12


def filmed(env):
    """Plays an episode; what a bare environment would have drawn."""
    play(env, ACTIONS[:LIMIT])
    bare = make(**PICTURES)
    bare.reset(seed=0)
    images = [bare.render()]
    for action in ACTIONS[:LIMIT]:
        bare.step(action)
        images.append(bare.render())
    return images


@case("HumanRendering")
def opens_a_window_on_the_picture(wrapper):
    bare, env = make(**PICTURES), wrapper(make(**PICTURES))
    bare.reset(seed=0), env.reset(seed=0)
    bare.step(ACTIONS[0]), env.step(ACTIONS[0])
    window = pygame.surfarray.array3d(env.window).transpose(1, 0, 2)
    assert_array_equal(window, bare.render())
    env.close()


def converts(wrapped, kind, action):
    """Observations of another library hold the same numbers; actions of it are taken."""
    plain, steps = play(make(), ACTIONS[:6]), play(wrapped, [action(a) for a in ACTIONS[:6]])
    for mine, theirs in zip(plain.obs, steps.obs, strict=True):
        assert isinstance(theirs, kind)
        assert_array_equal(np.asarray(theirs), mine)
    assert_allclose([float(r) for r in steps.rewards], plain.rewards, rtol=1e-6)
    assert bool(steps.truncated[-1])


IN_JAX = {"output": "jax"}


@case("ArrayConversion")
def hands_jax_out_for_numpy(wrapper):
    converts(wrapper(make(), env_xp=np, target_xp=jnp), jax.Array, jnp.asarray)


@case("JaxToNumpy")
def hands_numpy_out_for_jax(wrapper):
    converts(wrapper(make(**IN_JAX)), np.ndarray, np.asarray)


@case("JaxToTorch")
def hands_torch_out_for_jax(wrapper):
    converts(wrapper(make(**IN_JAX)), torch.Tensor, torch.as_tensor)


@case("NumpyToTorch")
def hands_torch_out_for_numpy(wrapper):
    converts(wrapper(make()), torch.Tensor, torch.as_tensor)
