"""GymnasiumVectorEnv: the three autoreset modes, masks, and independence of environments."""

from __future__ import annotations

import gc

import gymnasium
import jax
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from pixelbrax_gym import GymnasiumVectorEnv, check_vector_env
from pixelbrax_gym.interop.export import to_numpy
from tests.gym.conftest import SIZE, TASK
from tests.gym.test_registration import TASKS

MODES = ("next_step", "same_step", "disabled")
# Environment 0 goes left and times out, the others reach the end at different times.
ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)
LONG = {"episode_length": 17}


@pytest.mark.parametrize("output", ["numpy", "torch", "jax"])
@pytest.mark.parametrize("mode", MODES)
def test_checker_is_content(make_vector, mode, output):
    env = make_vector(
        autoreset_mode=mode,
        output=output,
        obs_mode="both",
        render_mode="rgb_array",
        render_height=8,
        render_width=8,
    )
    check_vector_env(env, num_steps=20)


def check_task(name, mode):
    env = gymnasium.make_vec(
        f"PixelBrax/{name}-v0",
        num_envs=2,
        height=16,
        width=16,
        obs_mode="both",  # at this size a reset moves less than a pixel
        max_episode_steps=6,
        autoreset_mode=mode,
        render_mode="rgb_array",
        render_height=8,
        render_width=8,
    )
    check_vector_env(env, num_steps=15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mode"),
    [*((name, "next_step") for name in sorted(TASKS)), *(("Reacher", m) for m in MODES[1:])],
)
def test_checker_is_content_with_every_task(name, mode):
    check_task(name, mode)


@pytest.mark.parametrize("mode", MODES)
def test_mode_is_in_metadata_and_attribute(make_vector, mode):
    env = make_vector(autoreset_mode=mode)
    assert env.metadata["autoreset_mode"] is env.autoreset_mode
    assert env.autoreset_mode is AutoresetMode[mode.upper()]
    assert make_vector(autoreset_mode=env.autoreset_mode).autoreset_mode is env.autoreset_mode
    assert make_vector(autoreset_mode=env.autoreset_mode.value).autoreset_mode is env.autoreset_mode
    assert type(env).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


def test_infos_follow_gymnasium(make_vector):
    env = make_vector(autoreset_mode="same_step", episode_length=3)
    env.reset(seed=0)
    keys = {"episode_return", "episode_length", "non_finite"}
    for count in range(1, 7):
        infos = env.step(ACTIONS)[4]
        masks = {f"_{key}" for key in keys}
        final = {"final_obs", "_final_obs", "final_info", "_final_info"}
        assert set(infos) == keys | masks | (final if count % 3 == 0 else set())
        assert all(infos[mask].all() for mask in masks)
    assert infos["final_obs"].dtype == object
    assert all(obs in env.single_observation_space for obs in infos["final_obs"])
    assert set(infos["final_info"]) == keys | masks
    np.testing.assert_array_equal(infos["final_info"]["episode_length"], [3, 3, 3])
    np.testing.assert_array_equal(infos["episode_length"], [0, 0, 0])


def test_final_entries_are_empty_where_no_episode_ended(make_vector):
    env = make_vector(autoreset_mode="same_step", **LONG)
    env.reset(seed=0)
    while True:
        _, _, terminated, truncated, infos = env.step(ACTIONS)
        if terminated.any():
            break
    done = terminated | truncated
    assert not done.all()
    np.testing.assert_array_equal([obs is not None for obs in infos["final_obs"]], done)
    np.testing.assert_array_equal(infos["_final_info"], done)
    assert not infos["final_info"]["episode_length"][~done].any()


def test_dense_final_entries_of_torch(make_vector):
    env = make_vector(autoreset_mode="same_step", output="torch", episode_length=2)
    plain = make_vector(autoreset_mode="same_step", episode_length=2)
    env.reset(seed=0), plain.reset(seed=0)
    infos = env.step(torch.from_numpy(ACTIONS))[4]
    assert isinstance(infos["final_obs"], torch.Tensor)
    assert not infos["_final_obs"].any()
    plain.step(ACTIONS)
    infos, expected = env.step(torch.from_numpy(ACTIONS))[4], plain.step(ACTIONS)[4]
    assert infos["_final_obs"].all()
    np.testing.assert_array_equal(infos["final_obs"], np.stack(expected["final_obs"]))
    np.testing.assert_array_equal(
        infos["final_info"]["episode_return"], expected["final_info"]["episode_return"]
    )


def test_observations_outlive_their_environment():
    env = GymnasiumVectorEnv(TASK, 3, **SIZE)
    obs, _ = env.reset(seed=0)
    kept, before = obs[1], obs[1].copy()
    env.close()
    del env, obs
    gc.collect()
    jax.block_until_ready([jax.numpy.full((3, 12, 12, 6), 7, np.uint8) for _ in range(50)])
    np.testing.assert_array_equal(kept, before)


def test_sub_envs_are_addressed_as_in_gymnasium(make_vector):
    env = make_vector(render_mode="rgb_array", render_height=8, render_width=8)
    env.reset(seed=0)
    images = env.call("render")
    assert len(images) == 3
    np.testing.assert_array_equal(images, env.render())
    assert env.get_attr("render_mode") == ("rgb_array",) * 3
    assert env.get_attr("spec")[2] == env.spec
    env.set_attr("level", [1, 2, 3])
    env.set_attr("name", "all")
    assert env.call("level") == (1, 2, 3)
    assert env.get_attr("name") == ("all",) * 3
    with pytest.raises(ValueError, match="one value for each of 3, got 2"):
        env.set_attr("level", [1, 2])
    env.set_attr("metadata", {"mine": 1})
    assert env.get_attr("metadata") == ({"mine": 1},) * 3
    with pytest.raises(AttributeError, match=r"no attribute 'rendr'\. Did you mean 'render'\?"):
        env.call("rendr")


@pytest.mark.parametrize("dtype", ["float32", "bfloat16", "bool", "uint8", "int32"])
def test_arrays_are_handed_out_as_they_are(dtype):
    given = jax.numpy.arange(6).reshape(2, 3).astype(dtype)
    expected = np.array(given)
    (array,) = to_numpy([given])
    assert array.dtype == given.dtype
    np.testing.assert_array_equal(array, expected)
    array[0, 0] = 1
    assert to_numpy(given[:0]).shape == (0, 3)


@pytest.mark.parametrize("mode", MODES)
def test_reset_mask_touches_one_row(make_vector, mode):
    env, other = make_vector(autoreset_mode=mode), make_vector(autoreset_mode=mode)
    for each in (env, other):
        each.reset(seed=0)
        before = each.step(ACTIONS)[0]
    options = {"reset_mask": np.array([False, True, False])}
    obs, infos = env.reset(options=options)
    np.testing.assert_array_equal(options["reset_mask"], [False, True, False])
    assert set(options) == {"reset_mask"}
    np.testing.assert_array_equal(infos["_episode_length"], [False, True, False])
    np.testing.assert_array_equal(infos["episode_length"], [1, 0, 1])
    np.testing.assert_array_equal(obs[[0, 2]], before[[0, 2]])
    assert not np.array_equal(obs[1], before[1])
    for _ in range(4):
        mine, theirs = env.step(ACTIONS), other.step(ACTIONS)
        for left, right in zip(mine[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(left[[0, 2]], right[[0, 2]])


def test_reset_mask_cancels_a_pending_autoreset(make_vector):
    env = make_vector(episode_length=2)
    env.reset(seed=0)
    env.step(ACTIONS)
    assert env.step(ACTIONS)[3].all()
    env.reset(options={"reset_mask": np.array([True, False, True])})
    _, reward, _, _, infos = env.step(ACTIONS)
    np.testing.assert_array_equal(infos["episode_length"], [1, 0, 1])
    assert reward[1] == 0.0


def test_reset_mask_with_a_seed(make_vector):
    env = make_vector(obs_mode="state")
    first, _ = env.reset(seed=0)
    env.step(ACTIONS)
    obs, _ = env.reset(seed=0, options={"reset_mask": np.array([False, False, True])})
    np.testing.assert_array_equal(obs[2], first[2])
    assert not np.array_equal(obs[0], first[0])


def test_seeds(make_vector):
    env = make_vector(obs_mode="state")
    first = np.array(env.reset(seed=4)[0])
    np.testing.assert_array_equal(env.reset(seed=[4, 5, 6])[0], first)
    np.testing.assert_array_equal(env.reset(seed=np.int64(4))[0], first)
    np.testing.assert_array_equal(env.reset(seed=[6, 4, 5])[0], first[[2, 0, 1]])
    second = np.array(env.reset()[0])
    assert not np.isin(second[:, 0], first[:, 0]).any()
    mixed = env.reset(seed=[None, 4, None])[0]
    np.testing.assert_array_equal(mixed[1], first[0])
    assert not np.array_equal(mixed[0], second[0])
    np.testing.assert_array_equal(env.reset(seed=[6, None, None])[0][0], first[2])


def test_non_finite_actions_on_the_device_end_the_episode(make_vector):
    env = make_vector(output="jax")
    env.reset(seed=0)
    actions = jax.numpy.asarray(ACTIONS).at[1].set(jax.numpy.nan)
    _, reward, terminated, _, infos = env.step(actions)
    np.testing.assert_array_equal(terminated, [False, True, False])
    np.testing.assert_array_equal(infos["non_finite"], [False, True, False])
    assert np.isfinite(reward).all()
