"""Every wrapper of Gymnasium for vector environments does what it says on ours."""

from __future__ import annotations

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pygame
import pytest
import torch
from gymnasium import wrappers as single
from gymnasium.vector.utils import (
    batch_space,
    concatenate,
    create_empty_array,
    create_shared_memory,
    iterate,
    read_from_shared_memory,
    write_to_shared_memory,
)
from gymnasium.wrappers import vector as wrappers
from numpy.testing import assert_allclose, assert_array_equal

from tests.clients.ball import ACTIONS, LIMIT, frames_of, make, make_vec, play
from tests.clients.wrapper_cases import CHANGES, PICTURES, UNSEEN, cases, darken, moments, same

CASES, case = cases()
close = partial(assert_allclose, rtol=0, atol=1e-6)
# Three balls that go their own ways, beyond the end of the first episode.
MANY = np.stack([ACTIONS, -ACTIONS, ACTIONS[::-1]], axis=1)


@pytest.mark.parametrize("name", wrappers.__all__)
def test_wrapper(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if name in CHANGES:
        wrap, *changes, obs_mode = CHANGES[name]
        compare(partial(wrap, wrappers), *changes, obs_mode=obs_mode)
        return
    assert name in CASES, f"Gymnasium has a new wrapper, {name}: write a case for it"
    CASES[name](getattr(wrappers, name))


def test_no_case_is_of_a_wrapper_that_is_gone():
    assert {*CASES, *CHANGES} <= set(wrappers.__all__)


def compare(wrap, obs=same, reward=same, action=same, **options):
    """Asserts that a wrapper changes these things in this way, and nothing else.

    Observations are changed for each environment by itself. Gymnasium has no wrapper of
    observations that also sees the final ones of same-step autoreset, and says so.
    """
    if obs is not same:
        with pytest.raises(ValueError, match="SAME_STEP"):
            wrap(make_vec(autoreset_mode="same_step", **options))
    for mode in ["next_step"] + ["same_step"] * (obs is same):
        plain = play(make_vec(autoreset_mode=mode, **options), action(MANY))
        wrapped = wrap(make_vec(autoreset_mode=mode, **options))
        assert wrapped.metadata["autoreset_mode"].name.lower() == mode
        steps = play(wrapped, MANY)
        for mine, theirs in zip(plain.obs, steps.obs, strict=True):
            expected = [obs(row_of(mine, i)) for i in range(3)]
            assert theirs in wrapped.observation_space
            jax.tree.map(close, theirs, batch(expected))
            for i in range(3):
                assert row_of(theirs, i) in wrapped.single_observation_space
        assert_allclose(steps.rewards, reward(np.array(plain.rewards)), rtol=1e-6)
        assert_array_equal(steps.terminated, plain.terminated)
        assert_array_equal(steps.truncated, plain.truncated)
        assert np.all(steps.truncated[LIMIT - 1])
        assert ("final_obs" in steps.infos[LIMIT]) == (mode == "same_step")


def row_of(obs, i):
    """The observation of one environment, its own copy."""
    return jax.tree.map(lambda x: np.array(x[i]), obs)


def batch(rows):
    """Observations of single environments as one."""
    return jax.tree.map(lambda *xs: np.stack(xs), *rows)


@case("VectorizeTransformObservation")
def may_write_to_what_it_gets_one_by_one(wrapper):
    def wrap(envs):
        return wrapper(envs, single.TransformObservation, func=darken, observation_space=None)

    compare(wrap, obs=lambda pixels: pixels // 2)


@case("VectorizeTransformAction")
def takes_the_opposite_one_by_one(wrapper):
    def wrap(envs):
        return wrapper(envs, single.TransformAction, func=lambda a: -a, action_space=None)

    compare(wrap, action=lambda action: -action)


@case("VectorizeTransformReward")
def pays_otherwise_one_by_one(wrapper):
    def wrap(envs):
        return wrapper(envs, single.TransformReward, func=lambda reward: 2 * reward + 1)

    compare(wrap, reward=lambda reward: 2 * reward + 1)


@case("DictInfoToList")
def lists_infos_by_environment(wrapper):
    plain, steps = play(make_vec(), MANY), play(wrapper(make_vec()), MANY)
    for mine, theirs in zip(plain.infos, steps.infos, strict=True):
        assert len(theirs) == 3
        for i, info in enumerate(theirs):
            for name in ("episode_return", "episode_length", "non_finite"):
                if mine[f"_{name}"][i]:
                    assert info[name] == mine[name][i]
                else:
                    assert name not in info
    # The final ones, too.
    (*_, infos) = play(wrapper(make_vec(autoreset_mode="same_step")), MANY[:LIMIT]).infos
    for i, info in enumerate(infos):
        assert info["final_info"]["episode_length"] == LIMIT
        assert info["final_obs"].shape == (12, 12, 3), i


@case("NormalizeObservation")
def shows_deviations_from_the_mean_so_far(wrapper):
    plain = play(make_vec(**UNSEEN), MANY).obs
    for t, obs in enumerate(play(wrapper(make_vec(**UNSEEN)), MANY).obs):
        seen = np.array(plain[: t + 1], np.float64)
        mean, var = moments(seen.reshape(-1, 2))
        # float32 sums of thirty numbers, divided by deviations of at least 0.01.
        assert_allclose(obs, (seen[-1] - mean) / np.sqrt(var + 1e-8), atol=1e-3)
    with pytest.raises(ValueError, match="NEXT_STEP"):
        wrapper(make_vec(autoreset_mode="same_step"))


@case("NormalizeReward")
def pays_in_deviations_of_the_discounted_return(wrapper):
    plain, steps = play(make_vec(), MANY), play(wrapper(make_vec(), gamma=0.5), MANY)
    returns, seen = np.zeros(3), []
    for t in range(LIMIT):
        returns = 0.5 * returns + plain.rewards[t]
        seen.extend(returns)
        _, var = moments(np.array(seen))
        assert_allclose(steps.rewards[t], plain.rewards[t] / np.sqrt(var + 1e-8), rtol=1e-4)
    # The step that only resets.
    assert_array_equal(steps.rewards[LIMIT], [0, 0, 0])


@case("RecordEpisodeStatistics")
def sums_rewards(wrapper):
    for mode in ("next_step", "same_step"):
        steps = play(wrapper(make_vec(autoreset_mode=mode)), MANY)
        (told,) = [info for info in steps.infos if "episode" in info]
        assert_allclose(told["episode"]["r"], np.sum(steps.rewards[:LIMIT], axis=0), rtol=1e-5)
        assert_array_equal(told["episode"]["l"], [LIMIT] * 3)
        assert_array_equal(told["_episode"], [True] * 3)


@case("RecordVideo")
def films_all_side_by_side(wrapper):
    envs = wrapper(
        make_vec(**PICTURES), "videos", video_aspect_ratio=(3, 1), episode_trigger=lambda i: i == 0
    )
    play(envs, MANY)
    bare, expected = make_vec(**PICTURES), []
    bare.reset(seed=0)
    for actions in [None, *MANY[:LIMIT]]:
        if actions is not None:
            bare.step(actions)
        expected.append(np.concatenate(bare.render(), axis=1))
    film = frames_of("videos/rl-video-episode-0.mp4")
    assert film.shape == (LIMIT + 1, 32, 96, 3)
    # The codec loses a little.
    assert np.abs(film - np.array(expected, float)).mean() < 12


@case("HumanRendering")
def opens_a_window_on_all(wrapper):
    options = PICTURES | {"num_envs": 4}
    bare, envs = make_vec(**options), wrapper(make_vec(**options), screen_size=(64, 64))
    bare.reset(seed=0), envs.reset(seed=0)
    window = pygame.surfarray.array3d(envs.window).transpose(1, 0, 2)
    a, b, c, d = bare.render()
    assert_array_equal(window, np.block([[[a], [b]], [[c], [d]]]))
    envs.close()


def converts(wrap, kind, action, mode="next_step", **options):
    """Observations of another library hold the same numbers; actions of it are taken."""
    options["autoreset_mode"] = mode
    plain = play(make_vec(autoreset_mode=mode), MANY)
    steps = play(wrap(make_vec(**options)), [action(a) for a in MANY])
    for part in ("obs", "rewards", "terminated", "truncated"):
        for mine, theirs in zip(getattr(plain, part), getattr(steps, part), strict=True):
            assert isinstance(theirs, kind)
            assert_array_equal(np.asarray(theirs), mine)
    for mine, theirs in zip(plain.infos, steps.infos, strict=True):
        assert_array_equal(np.asarray(theirs["episode_return"]), mine["episode_return"])
    return steps


@case("ArrayConversion")
def hands_jax_out_for_numpy(wrapper):
    converts(lambda envs: wrapper(envs, env_xp=np, target_xp=jnp), jax.Array, jnp.asarray)


@case("JaxToNumpy")
def hands_numpy_out_for_jax(wrapper):
    for mode in ("next_step", "same_step"):
        converts(wrapper, np.ndarray, np.asarray, mode, output="jax")


@case("JaxToTorch")
def hands_torch_out_for_jax(wrapper):
    for mode in ("next_step", "same_step"):
        steps = converts(wrapper, torch.Tensor, torch.as_tensor, mode, output="jax")
    assert isinstance(steps.infos[LIMIT]["final_obs"], torch.Tensor)
    # A mask for a partial reset comes over as well.
    envs = wrapper(make_vec(output="jax", autoreset_mode="disabled"))
    before, _ = envs.reset(seed=0)
    before, *_ = envs.step(torch.as_tensor(MANY[0]))
    mask = torch.tensor([False, True, False])
    after, _ = envs.reset(options={"reset_mask": mask})
    assert_array_equal((after != before).flatten(1).any(1), mask)


@case("NumpyToTorch")
def hands_torch_out_for_numpy(wrapper):
    converts(wrapper, torch.Tensor, torch.as_tensor)


@pytest.mark.parametrize("observation_mode", ["same", "different"])
def test_gymnasium_runs_single_environments_one_after_the_other(observation_mode):
    envs = gymnasium.vector.SyncVectorEnv([make] * 3, observation_mode=observation_mode)
    plain, steps = play(make_vec(), MANY), play(envs, MANY)
    for mine, theirs in zip(plain.obs, steps.obs, strict=True):
        assert_array_equal(np.stack(theirs), mine)
    assert_allclose(steps.rewards, plain.rewards, rtol=1e-6)
    assert_array_equal(steps.truncated, plain.truncated)


def test_gymnasiums_tools_know_our_spaces():
    for obs_mode in ("pixels", "state", "both"):
        envs = make_vec(obs_mode=obs_mode)
        obs, _ = envs.reset(seed=0)
        assert batch_space(envs.single_observation_space, 3) == envs.observation_space
        rows = list(iterate(envs.observation_space, obs))
        assert len(rows) == 3
        one = envs.single_observation_space
        jax.tree.map(assert_array_equal, concatenate(one, rows, create_empty_array(one, 3)), obs)
        memory = create_shared_memory(one, 3)
        for i, row in enumerate(rows):
            write_to_shared_memory(one, i, row, memory)
        jax.tree.map(assert_array_equal, read_from_shared_memory(one, memory, 3), obs)


def test_workers_that_are_spawned_hand_out_the_same():
    envs = gymnasium.vector.AsyncVectorEnv([make] * 3, context="spawn")
    plain, steps = play(make_vec(), MANY), play(envs, MANY)
    assert_array_equal(steps.obs, plain.obs)
    assert_array_equal(steps.truncated, plain.truncated)
