"""Gymnasium's own wrappers on top."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

from tests.gym.conftest import ID, SIZE

ACTIONS = np.full((3, 1), -0.1, np.float32)


def test_record_episode_statistics(make_single):
    env = wrappers.RecordEpisodeStatistics(make_single(obs_mode="state"))
    env.reset(seed=0)
    total, truncated = 0.0, False
    while not truncated:
        _, reward, _, truncated, info = env.step(ACTIONS[0])
        total += reward
    assert info["episode"]["l"] == info["episode_length"] == 6
    assert info["episode"]["r"] == pytest.approx(total)
    assert info["episode_return"] == pytest.approx(total)


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_record_episode_statistics_of_many(make_vector, mode):
    env = vector_wrappers.RecordEpisodeStatistics(
        make_vector(obs_mode="state", autoreset_mode=mode)
    )
    env.reset(seed=0)
    for _ in range(6):
        infos = env.step(ACTIONS)[4]
    ours = infos["final_info"] if mode == "same_step" else infos
    np.testing.assert_array_equal(infos["episode"]["l"], [6, 6, 6])
    np.testing.assert_allclose(infos["episode"]["r"], ours["episode_return"], rtol=1e-5)


def test_statistics_survive_a_partial_reset(make_vector):
    # The wrapper looks for the mask after the environment has seen it: it must still be there.
    env = vector_wrappers.RecordEpisodeStatistics(
        make_vector(obs_mode="state", autoreset_mode="disabled")
    )
    env.reset(seed=0)
    for _ in range(3):
        env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    for _ in range(3):
        infos = env.step(ACTIONS)[4]
    np.testing.assert_array_equal(infos["_episode"], [False, True, True])
    np.testing.assert_array_equal(infos["episode"]["l"], [0, 6, 6])


def test_record_video(make_single, tmp_path):
    options = {"render_mode": "rgb_array", "render_height": 16, "render_width": 16}
    env = wrappers.RecordVideo(
        make_single(**options), str(tmp_path / "videos"), episode_trigger=lambda _: True
    )
    env.reset(seed=0)
    for _ in range(6):
        env.step(ACTIONS[0])
    env.close()
    assert [path.name for path in tmp_path.glob("videos/*.mp4")] == ["rl-video-episode-0.mp4"]


def test_record_video_of_many(make_vector, tmp_path):
    options = {"render_mode": "rgb_array", "render_height": 16, "render_width": 16}
    env = vector_wrappers.RecordVideo(
        make_vector(**options), str(tmp_path / "videos"), episode_trigger=lambda _: True
    )
    env.reset(seed=0)
    for _ in range(8):
        env.step(ACTIONS)
    env.close()
    assert list(tmp_path.glob("videos/*.mp4"))


def test_frame_stack(make_single):
    env = wrappers.FrameStackObservation(make_single(frame_stack=1), 3)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (3, 12, 12, 3)
    assert env.step(ACTIONS[0])[0] in env.observation_space


def test_frame_stack_of_ours_is_that_of_gymnasium(make_single):
    theirs = wrappers.FrameStackObservation(make_single(frame_stack=1), 2)
    ours = make_single(frame_stack=2)
    pairs = [(ours.reset(seed=0)[0], theirs.reset(seed=0)[0])]
    pairs += [(ours.step(np.ones(1))[0], theirs.step(np.ones(1))[0]) for _ in range(4)]
    for mine, other in pairs[1:]:
        np.testing.assert_array_equal(mine, np.concatenate(list(other), axis=-1))


def test_normalize_reward(make_single, make_vector):
    env = wrappers.NormalizeReward(make_single(obs_mode="state"))
    env.reset(seed=0)
    assert np.isfinite(env.step(ACTIONS[0])[1])


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_normalize_reward_of_many(make_vector, mode):
    env = vector_wrappers.NormalizeReward(make_vector(obs_mode="state", autoreset_mode=mode))
    env.reset(seed=0)
    for _ in range(10):
        assert np.isfinite(env.step(ACTIONS)[1]).all()


def test_normalize_observation_of_many(make_vector):
    env = vector_wrappers.NormalizeObservation(make_vector(obs_mode="state"))
    env.reset(seed=0)
    for _ in range(10):
        assert np.isfinite(env.step(ACTIONS)[0]).all()


def test_frame_stack_of_many():
    env = gymnasium.make_vec(
        ID,
        num_envs=2,
        vectorization_mode="sync",
        wrappers=[lambda env: wrappers.FrameStackObservation(env, 2)],
        **(SIZE | {"frame_stack": 1}),
    )
    obs, _ = env.reset(seed=0)
    assert obs.shape == (2, 2, 12, 12, 3)
