"""GymnasiumEnv: what it returns, and that Gymnasium's own checker is content."""

from __future__ import annotations

import gymnasium
import jax
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from tests.gym.conftest import ID, SIZE
from tests.gym.test_registration import TASKS

ACTION = np.array([0.3], np.float32)


def run(env, num_steps=4, seed=3):
    steps = [env.reset(seed=seed)]
    return steps + [env.step(ACTION) for _ in range(num_steps)]


@pytest.mark.parametrize("obs_mode", ["pixels", "both"])
def test_gymnasiums_checker_on_the_toy(obs_mode):
    options = SIZE | {"obs_mode": obs_mode, "render_height": 9, "render_width": 8}
    # Gymnasium advises against unbounded observations, which a state is.
    if obs_mode == "pixels":
        check_env(gymnasium.make(ID, **options).unwrapped)
    else:
        with pytest.warns(UserWarning, match="infinity"):
            check_env(gymnasium.make(ID, **options).unwrapped)


def check_task(name):
    options = {"height": 16, "width": 16, "render_height": 8, "render_width": 8}
    check_env(gymnasium.make(f"PixelBrax/{name}-v0", **options).unwrapped)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_gymnasiums_checker_on_every_task(name):
    check_task(name)


def test_results_are_plain(make_single):
    env = make_single()
    obs, info = env.reset(seed=0)
    assert obs in env.observation_space
    assert info == {"episode_return": 0.0, "episode_length": 0, "non_finite": False}
    obs, reward, terminated, truncated, info = env.step(ACTION)
    assert obs.dtype == np.uint8
    assert obs.shape == (12, 12, 6)
    assert [type(x) for x in (reward, terminated, truncated)] == [float, bool, bool]
    assert {name: type(value) for name, value in info.items()} == {
        "episode_return": float,
        "episode_length": int,
        "non_finite": bool,
    }
    assert info["episode_return"] == reward


def test_a_reset_opens_a_closed_environment_again(make_single):
    env = make_single()
    before = env.reset(seed=3)[0].copy()
    env.step(ACTION)
    env.close()
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step"):
        env.step(ACTION)
    np.testing.assert_array_equal(env.reset(seed=3)[0], before)
    env.step(ACTION)


@pytest.mark.parametrize(("output", "kind"), [("torch", torch.Tensor), ("jax", jax.Array)])
def test_other_outputs_hold_the_same_numbers(make_single, output, kind):
    plain, other = (
        run(make_single(obs_mode="both")),
        run(make_single(obs_mode="both", output=output)),
    )
    for (obs, *rest), (obs_other, *rest_other) in zip(plain, other, strict=True):
        assert rest == rest_other
        for name in ("pixels", "state"):
            assert isinstance(obs_other[name], kind)
            np.testing.assert_array_equal(obs[name], np.asarray(obs_other[name]))


@pytest.mark.parametrize(
    "convert",
    [
        *(list, np.float64, np.float16, torch.as_tensor, torch.DoubleTensor, jax.numpy.asarray),
        lambda action: np.asarray(action, jax.numpy.bfloat16),
    ],
)
def test_actions_of_any_floating_kind(make_single, convert):
    action = np.array([0.25], np.float32)
    env = make_single(obs_mode="state")
    env.reset(seed=0)
    expected = env.step(action)[0]
    env.reset(seed=0)
    given = (
        action.astype(convert)
        if isinstance(convert, type(np.float64)) and issubclass(convert, np.generic)
        else convert(action)
    )
    np.testing.assert_array_equal(env.step(given)[0], expected)


def test_seeding(make_single):
    env, other = make_single(obs_mode="state"), make_single(obs_mode="state")
    first, second, third = env.reset(seed=7)[0], env.reset()[0], env.reset()[0]
    assert len({x.tobytes() for x in (first, second, third)}) == 3
    np.testing.assert_array_equal(other.reset(seed=7)[0], first)
    # An episode depends on the seed and its number, not on what happened in the one before.
    other.step(ACTION)
    np.testing.assert_array_equal(other.reset()[0], second)
    np.testing.assert_array_equal(env.reset(seed=7)[0], first)


def test_no_seed_means_a_fresh_one(make_single):
    first = [make_single(obs_mode="state").reset()[0].tobytes() for _ in range(3)]
    assert len(set(first)) == 3


def test_render(make_single):
    env = make_single(render_mode="rgb_array", render_height=20, render_width=30)
    env.reset(seed=0)
    before = env.render()
    assert before.shape == (20, 30, 3)
    assert before.dtype == np.uint8
    assert not np.array_equal(before, np.full_like(before, before[0, 0]))
    for _ in range(4):
        env.step(np.ones(1))
    assert not np.array_equal(before, env.render())
    assert make_single().render() is None
    assert env.metadata["render_fps"] == 10  # a tenth of a second a step


def test_render_at_the_observations_size_is_the_observation(make_single):
    env = make_single(render_mode="rgb_array", render_height=12, render_width=12)
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), obs[..., -3:])


def test_render_without_pixels(make_single):
    env = make_single(obs_mode="state", render_mode="rgb_array", render_height=5, render_width=4)
    env.reset(seed=0)
    assert env.render().shape == (5, 4, 3)


def test_human_mode_shows_a_window(make_single):
    env = make_single(render_mode="human", render_height=40, render_width=60)
    env.reset(seed=0)
    env.step(ACTION)
    assert env.render() is None
    import pygame

    screen = pygame.display.get_surface()
    assert screen.get_size() == (60, 40)
    shown = pygame.surfarray.array3d(screen).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, env._picture())
    env.close()
    assert pygame.display.get_surface() is None


def test_rgb_array_list_of_gymnasium():
    env = gymnasium.make(ID, **SIZE, render_mode="rgb_array_list", render_height=6, render_width=6)
    env.reset(seed=0)
    env.step(ACTION)
    assert [frame.shape for frame in env.render()] == [(6, 6, 3)] * 2
