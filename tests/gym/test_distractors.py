"""Distractors through the adapters to PyTorch."""

from __future__ import annotations

import inspect

import gymnasium
import numpy as np
import pytest
import torch

import pixelbrax_gym
from pixelbrax_jax import distractors
from tests.distractors.conftest import make_bank
from tests.gym.conftest import ID, SIZE, TASK

ALL = (
    distractors.Video(mode="overlay"),
    "color",
    distractors.MovingCamera(scale=0.2),
)
OPTIONS = {"distractors": ALL, "clips": make_bank(height=12, width=12), "episode_length": 6}
ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)


def test_every_door_shows_the_same(make_vector, make_torchrl, make_sb3):
    vector = make_vector(autoreset_mode="same_step", **OPTIONS)
    torchrl, sb3 = make_torchrl(**OPTIONS), make_sb3(**OPTIONS)
    (pixels, _), td, obs = vector.reset(seed=0), torchrl.reset(), sb3.reset()
    plain = make_vector(**{"episode_length": 6}).reset(seed=0)[0]
    assert (pixels != plain).mean() > 0.8
    for _ in range(10):
        np.testing.assert_array_equal(pixels, td["pixels"])
        np.testing.assert_array_equal(pixels, obs)
        pixels, *_, infos = vector.step(ACTIONS)
        stepped, td = torchrl.step_and_maybe_reset(td.set("action", torch.from_numpy(ACTIONS)))
        obs, _, dones, sb3_infos = sb3.step(ACTIONS)
    assert infos["color"].shape == (3, 3)
    assert infos["_color"].all()
    assert infos["video_clip"].shape == (3,)
    assert torchrl.infos["camera"].shape == (3, 4)
    assert stepped["next", "pixels"].dtype == torch.uint8
    while not dones.any():
        _, _, dones, sb3_infos = sb3.step(ACTIONS)
    ended = sb3_infos[int(dones.argmax())]
    assert ended["color"].shape == (3,)
    assert isinstance(ended["video_clip"], int)


def test_a_single_environment_tells_of_them(make_single):
    env = make_single(**OPTIONS)
    _, info = env.reset(seed=0)
    assert info["color"].shape == (3,)
    assert isinstance(info["video_frame"], int)
    _, *_, later = env.step(ACTIONS[0])
    assert not np.shares_memory(later["color"], info["color"])
    assert (later["color"] != info["color"]).all()


def test_render_shows_them(make_vector):
    options = {"render_mode": "rgb_array", "render_height": 24, "render_width": 24}
    env, plain = make_vector(**OPTIONS, **options), make_vector(episode_length=6, **options)
    env.reset(seed=0), plain.reset(seed=0)
    assert (env.render()[0] != plain.render()[0]).mean() > 0.8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distractors": "colour"}, "unknown distractor: 'colour'.*Did you mean 'color'"),
        ({"distractors": "video", "clips": "/nowhere"}, "no folder of clips at /nowhere"),
        ({"distractors": "video", "clips": "procedural", "split": "val"}, "unknown split"),
    ],
)
def test_mistakes_are_told_before_anything_is_compiled(options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        pixelbrax_gym.GymnasiumVectorEnv(TASK, 2, **SIZE, **options)


@pytest.mark.parametrize(
    "make",
    [
        lambda **options: pixelbrax_gym.GymnasiumEnv(TASK, **options),
        lambda **options: pixelbrax_gym.GymnasiumVectorEnv(TASK, 2, **options),
        lambda **options: pixelbrax_gym.TorchRLEnv(TASK, 2, **options),
        lambda **options: pixelbrax_gym.SB3VecEnv(TASK, 2, **options),
        lambda **options: gymnasium.make(ID, **options),
        lambda **options: gymnasium.make_vec(ID, num_envs=2, **options),
        lambda **options: gymnasium.make_vec(ID, num_envs=1, vectorization_mode="sync", **options),
    ],
)
def test_the_warning_about_clips_points_at_the_line_of_the_user(make):
    with pytest.warns(distractors.ProceduralClipsWarning) as told:
        make(**SIZE, distractors="video").close()
    (warning,) = told
    assert warning.filename == __file__
    first = make.__code__.co_firstlineno
    assert first <= warning.lineno < first + len(inspect.getsource(make).splitlines())
