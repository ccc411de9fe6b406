"""Every mistake is named, with its cure, and leaves the environment usable."""

from __future__ import annotations

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded

from pixelbrax_gym import GymnasiumEnv, GymnasiumVectorEnv, SB3VecEnv, TorchRLEnv
from tests.gym.adapters import ACTIONS, ADAPTERS
from tests.gym.conftest import ID, TASK


@pytest.mark.parametrize("kind", [GymnasiumEnv, GymnasiumVectorEnv])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"output": "tensor"}, "unknown output: 'tensor'; allowed: jax, numpy, torch"),
        ({"render_mode": "ansi"}, "unknown render_mode: 'ansi'"),
        ({"render_height": 0}, "render_height must be a positive integer"),
        ({"render_width": 2.5}, "render_width must be a positive integer"),
        ({"height": 0}, "height must be a positive integer"),
        ({"obs_mode": "pixel"}, r"Did you mean 'pixels'\?"),
        ({"camera": "nowhere"}, "camera"),
        ({"look": "nice"}, "unknown look"),
        ({"split": "test"}, "split='test' is given without a distractor that has splits: add"),
        ({"split": "test", "distractors": "color"}, "without a distractor that has splits"),
        (
            {"backend": "mjx"},
            "only for Brax.s tasks, .* leave it out, or give it where the task's physics is made",
        ),
        ({"max_episode_steps": 0}, "max_episode_steps must be a positive integer"),
        ({"max_episode_steps": -2}, "max_episode_steps must be a positive integer"),
    ],
)
def test_options(kind, options, message):
    with pytest.raises(ValueError, match=message):
        kind(TASK, **options)


@pytest.mark.parametrize("kind", [GymnasiumEnv, GymnasiumVectorEnv])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"heigth": 3},
            r"unexpected keyword argument 'heigth'; allowed: .*width.* Did you mean 'height'\?",
        ),
        ({"rendermode": 3}, r"Did you mean 'render_mode'\?"),
        ({"device": "cuda"}, r"on an NVIDIA GPU with the extra cuda12"),
        ({"image_size": 64}, r"Did you mean 'height' and 'width'\?"),
        ({"frame_skip": 3}, r"Did you mean 'action_repeat'\?"),
        ({"backend": ("a", ["b"])}, r"backend must be a single value, got a tuple"),
        ({"backend": ["spring"]}, r"backend must be a single value, got a list: \['spring'\]"),
        ({"height": [84]}, "height must be a single value"),
        ({"split": {"train"}}, "split must be a single value"),
        ({"shadows": "yes"}, "shadows must be True or False, got 'yes'"),
        ({"distractors": 5}, "distractors must be a name, a Distractor or several of them, got 5"),
        ({"distractors": "video", "clips": ["a"]}, r"clips must be .*, got \['a'\]"),
    ],
)
def test_names_of_options(kind, options, message):
    with pytest.raises(TypeError, match=message):
        kind(TASK, **options)


@pytest.mark.parametrize("kind", [SB3VecEnv, TorchRLEnv])
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"heigth": 12}, TypeError, "unexpected keyword argument 'heigth'.*Did you mean 'height'"),
        ({"num_env": 12}, TypeError, "unexpected keyword .*num_envs.* Did you mean 'num_envs'"),
        ({"num_envs": 0}, ValueError, "a positive integer, got 0"),
        ({"render_height": 0}, ValueError, "render_height must be a positive integer"),
    ],
)
def test_options_of_other_frameworks(kind, options, error, message):
    with pytest.raises(error, match=message):
        kind(TASK, **options)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"render_mode": "human"}, ValueError, "rgb_array"),
        ({"channels_first": "yes"}, TypeError, "channels_first must be True or False, got 'yes'"),
        ({"stagger": 2}, TypeError, "stagger must be True or False, got 2"),
    ],
)
def test_options_of_stable_baselines(options, error, message):
    with pytest.raises(error, match=message):
        SB3VecEnv(TASK, **options)


def test_task():
    with pytest.raises(ValueError, match=r"'Ant'\. Did you mean 'ant'\? Allowed: ant"):
        GymnasiumEnv("Ant")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 2**31}, r"num_envs=2147483648, height=84.*at least 27\d,\d\d\d\.\d GB"),
        ({"num_envs": 2**40, "obs_mode": "state"}, "num_envs=1099511627776 would take"),
        ({"height": 10**6, "width": 10**6}, "num_envs=1, height=1000000, width=1000000"),
        ({"frame_stack": 10**10}, "frame_stack=10000000000 would take at least"),
        ({"render_height": 10**6, "render_width": 10**6}, r"render_height=1000000.*lower one"),
    ],
)
def test_sizes_that_cannot_fit(options, message):
    with pytest.raises(MemoryError, match=message):
        GymnasiumVectorEnv(TASK, **options)


def test_images_that_cannot_fit(make_vector):
    # Many environments are fine as long as nobody draws all of them.
    GymnasiumVectorEnv(TASK, 100_000, obs_mode="state", render_mode="rgb_array")
    size = {"render_height": 60_000, "render_width": 60_000}
    env = make_vector(obs_mode="state", render_mode="rgb_array", **size)
    env.reset(seed=0)
    with pytest.raises(MemoryError, match=r"images of num_envs=3, height=60000, width=60000"):
        env.render()


def test_mistyped_clips():
    with pytest.raises(FileNotFoundError, match=r"Did you mean 'procedural'\?"):
        GymnasiumVectorEnv(TASK, distractors="video", clips="procedual")


@pytest.mark.parametrize("num_envs", [0, -1, 1.5, True])
def test_num_envs(num_envs):
    with pytest.raises(ValueError, match="num_envs must be a positive integer"):
        GymnasiumVectorEnv(TASK, num_envs)


@pytest.mark.parametrize("mode", ["nextstep", None, "NEXT", ["next_step"]])
def test_autoreset_mode(mode):
    with pytest.raises(ValueError, match=r"unknown autoreset_mode.*llowed: disabled, next_step"):
        GymnasiumVectorEnv(TASK, 2, autoreset_mode=mode)


def test_human_rendering_of_many():
    with pytest.raises(ValueError, match=r"use gymnasium\.make for it, or "):
        GymnasiumVectorEnv(TASK, 2, render_mode="human")


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        (np.zeros((3, 2), np.float32), ValueError, r"shape \(3, 1\), got \(3, 2\)"),
        (np.zeros(3, np.float32), ValueError, r"shape \(3, 1\), got \(3,\)"),
        (torch.zeros(2, 1), ValueError, r"shape \(3, 1\), got \(2, 1\)"),
        (np.zeros((3, 1), int), TypeError, r"got int64; convert it to float32"),
        (np.zeros((3, 1), bool), TypeError, "got bool"),
        ([[1], [0], [1]], TypeError, "got int64"),
        (torch.zeros(3, 1, dtype=torch.int32), TypeError, "got torch.int32"),
        (np.array([["a"], ["b"], ["c"]]), TypeError, "must be floating point"),
        (None, ValueError, r"shape \(3, 1\), got \(\)"),
        ([[1.0], [1.0, 2.0], [3.0]], ValueError, "got rows of different lengths"),
        (torch.zeros(3, 1).to_sparse(), TypeError, r"must be a dense tensor.*to_dense"),
        (np.array([[0.0], [np.nan], [np.nan]]), ValueError, "environments 1, 2 contain NaN"),
        (torch.tensor([[0.0], [0.0], [torch.nan]]), ValueError, "environment 2 contains NaN"),
    ],
)
def test_actions_leave_the_environment_usable(make_vector, action, error, message):
    env, other = make_vector(obs_mode="state"), make_vector(obs_mode="state")
    env.reset(seed=0), other.reset(seed=0)
    with pytest.raises(error, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.step(ACTIONS)[0], other.step(ACTIONS)[0])


@pytest.mark.parametrize("name", ["sb3", "torchrl"])
@pytest.mark.parametrize(
    ("actions", "error", "message"),
    [
        (
            np.zeros((3, 2), np.float32),
            ValueError,
            r"action must have shape \(3, 1\), got \(3, 2\)",
        ),
        (np.zeros((3, 1), np.int64), TypeError, "floating point.*int64"),
        (np.full((3, 1), np.nan, np.float32), ValueError, "environments 0, 1, 2 contain NaN"),
    ],
)
def test_actions_of_other_frameworks(name, actions, error, message):
    adapter = ADAPTERS[name]()
    adapter.reset()
    with pytest.raises(error, match=message):
        adapter.call(actions)
    assert [event.obs["state"][1] for event in adapter.call()[0]] == [1.0] * 3


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        (0.5, ValueError, r"shape \(1,\), got \(\)"),
        (np.zeros(2), ValueError, r"shape \(1,\), got \(2,\)"),
        (np.zeros(1, int), TypeError, "floating point"),
        (np.array([np.nan]), ValueError, "the action contains NaN; nothing was stepped"),
    ],
)
def test_action_of_a_single_environment(make_single, action, error, message):
    env = make_single(obs_mode="state")
    env.reset(seed=0)
    with pytest.raises(error, match=message):
        env.step(action)
    env.step(ACTIONS[0])


def test_infinite_actions_are_clipped(make_single):
    env = make_single(obs_mode="state")
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.array([np.inf]))
    assert not info["non_finite"]


@pytest.mark.parametrize(
    ("mask", "error", "message"),
    [
        ([True, False, True], TypeError, "array or tensor of bool, got list"),
        (torch.ones(3), TypeError, "array or tensor of bool, got float32 array"),
        (np.ones(3, int), TypeError, "array or tensor of bool, got int64 array"),
        (np.ones(2, bool), ValueError, r"shape \(3,\), got \(2,\)"),
        (np.zeros(3, bool), ValueError, "at least one True"),
    ],
)
def test_reset_mask(make_vector, mask, error, message):
    env = make_vector(obs_mode="state")
    before = env.reset(seed=0)[0]
    with pytest.raises(error, match=message):
        env.reset(options={"reset_mask": mask})
    # A mask that is refused draws no numbers and begins no episode either.
    repeat = env.reset(seed=0)[0]
    np.testing.assert_array_equal(before, repeat)


@pytest.mark.parametrize("convert", [torch.from_numpy, jnp.asarray])
def test_reset_mask_of_any_kind(make_vector, convert):
    mask = np.array([True, False, True])
    env, other = make_vector(obs_mode="state"), make_vector(obs_mode="state")
    for each, given in ((env, convert(mask)), (other, mask)):
        each.reset(seed=0)
        each.step(ACTIONS)
        obs, _ = each.reset(options={"reset_mask": given})
        assert (obs[:, 1] == [0, 1, 0]).all()
    np.testing.assert_array_equal(env.step(ACTIONS)[0], other.step(ACTIONS)[0])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"reset_masks": np.ones(3, bool)}, ValueError, r"'reset_masks'.* mean 'reset_mask'\?"),
        (
            {"mask": np.ones(3, bool)},
            ValueError,
            r"'mask'\. Did you mean 'reset_mask'\? Allowed: reset_mask, state",
        ),
        ("abc", TypeError, r"options of reset\(\) must be a dict or None, got 'abc'"),
        ([1], TypeError, r"must be a dict or None, got \[1\]"),
        (5, TypeError, "must be a dict or None, got 5"),
    ],
)
def test_options_of_reset(make_vector, make_single, options, error, message):
    env, single = make_vector(obs_mode="state"), make_single(obs_mode="state")
    before = env.reset(seed=0, options={})[0]
    env.step(ACTIONS)
    with pytest.raises(error, match=message):
        env.reset(options=options)
    np.testing.assert_array_equal(env.reset(seed=0)[0], before)
    single.reset(seed=0, options={})
    with pytest.raises(
        error,
        match=message
        if error is TypeError
        else r"unknown option of reset\(\): '(reset_)?masks?'; allowed: state",
    ):
        single.reset(options=options)


def test_first_reset_must_be_whole(make_vector):
    env = make_vector(obs_mode="state")
    with pytest.raises(ResetNeeded, match="first reset must be of all"):
        env.reset(options={"reset_mask": np.array([True, False, True])})
    env.reset(options={"reset_mask": np.array([True, True, True])})


@pytest.mark.parametrize(
    ("seed", "error", "message"),
    [
        (-1, ValueError, r"\[0, 2\*\*32\), got -1"),
        (2**32, ValueError, r"\[0, 2\*\*32\), got 4294967296"),
        (2**32 - 1, ValueError, "seed=4294967295 would give 3 .* give at most 4294967293"),
        ([1, 2], ValueError, "seed has 2 entries, but there are 3 environments"),
        ([1, 2, -3], ValueError, r"\[0, 2\*\*32\), got -3"),
        (b"abc", TypeError, "an integer, got b'abc'"),
        ([1, 2, 0.5], TypeError, "an integer, got 0.5"),
        (0.5, TypeError, "an integer, got 0.5"),
        (True, TypeError, "an integer, got True"),
        ("7", TypeError, "an integer, got '7'"),
    ],
)
def test_seeds(make_vector, seed, error, message):
    env = make_vector(obs_mode="state")
    with pytest.raises(error, match=message):
        env.reset(seed=seed)
    env.reset(seed=2**32 - 3)


@pytest.mark.parametrize("convert", [np.array, np.int64, jnp.asarray, torch.as_tensor])
def test_seeds_of_any_kind(make_vector, make_single, convert):
    env, single = make_vector(obs_mode="state"), make_single(obs_mode="state")
    expected = env.reset(seed=3)[0]
    np.testing.assert_array_equal(env.reset(seed=convert(3))[0], expected)
    np.testing.assert_array_equal(single.reset(seed=convert(3))[0], expected[0])
    if convert is not np.int64:
        np.testing.assert_array_equal(env.reset(seed=convert([3, 4, 5]))[0], expected)


def test_order_of_calls(make_vector, make_single):
    for env, action in (
        (make_vector(render_mode="rgb_array"), ACTIONS),
        (make_single(render_mode="rgb_array"), ACTIONS[0]),
    ):
        with pytest.raises(ResetNeeded, match=r"call reset\(\) before step"):
            env.step(action)
        with pytest.raises(ResetNeeded, match=r"call reset\(\) before render"):
            env.render()
        env.reset(seed=0)
        env.close()
        env.close()
        calls = [lambda env=env: env.step(ACTIONS), env.render]
        if isinstance(env.unwrapped, GymnasiumVectorEnv):
            kind, message, calls = ClosedEnvironmentError, "make a new one", [env.reset, *calls]
        else:
            kind, message = ResetNeeded, r"call reset\(\) before"
        for call in calls:
            with pytest.raises(kind, match=message):
                call()


def test_stepping_on_after_the_end(make_vector, make_single):
    env = make_vector(autoreset_mode="disabled", obs_mode="state", episode_length=2)
    env.reset(seed=0)
    env.step(ACTIONS)
    env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(ResetNeeded, match=r"environment 0, 2 has ended.*reset_mask"):
        env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    env.step(ACTIONS)

    single = make_single(obs_mode="state", episode_length=1)
    single.reset(seed=0)
    single.step(ACTIONS[0])
    with pytest.raises(ResetNeeded, match="the episode has ended; call reset"):
        single.step(ACTIONS[0])


def test_gymnasium_passes_messages_on():
    with pytest.raises(
        TypeError, match=r"unexpected keyword argument 'widht'.*Did you mean 'width'\?"
    ):
        gymnasium.make(ID, widht=3)
    with pytest.raises(
        TypeError, match=r"unexpected keyword argument 'widht'.*Did you mean 'width'\?"
    ):
        gymnasium.make_vec(ID, num_envs=2, widht=3)
