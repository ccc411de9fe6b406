"""``pixelbrax play``: windows, files, and what they show."""

from __future__ import annotations

import sys
from itertools import islice

import imageio.v3 as imageio
import numpy as np
import pytest

from pixelbrax_gym.cli import main, play
from pixelbrax_gym.gymnasium.env import GymnasiumEnv
from pixelbrax_gym.gymnasium.window import Window

TASK = "inverted_pendulum"
SHORT = ("--num-frames", "3", "--size", "40")


@pytest.fixture
def _no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.slow
@pytest.mark.usefixtures("_no_display")
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_a_display_it_becomes_a_gif(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["play", TASK, *SHORT]) == 0
    told = capsys.readouterr()
    assert "there is no display; writing inverted_pendulum.gif instead" in told.err
    assert told.out.strip() == str(tmp_path / "inverted_pendulum.gif")
    assert imageio.imread(tmp_path / "inverted_pendulum.gif", index=None).shape == (3, 40, 40, 3)


@pytest.mark.usefixtures("_no_display")
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_what_is_missing_is_told_before_anything_else(monkeypatch, capsys):
    monkeypatch.setattr(play, "find_spec", lambda name: None)
    assert main(["play", TASK, *SHORT]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "[human]" in line
    assert "[video]" in line


def test_a_window_until_it_is_closed(monkeypatch):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    shown = []

    def show(self, image, original=Window.show):
        shown.append(image)
        if len(shown) == 2:
            pygame.event.post(pygame.event.Event(pygame.QUIT))
        original(self, image)

    monkeypatch.setattr(Window, "show", show)
    assert main(["play", TASK, "--size", "40"]) == 0
    assert len(shown) == 2
    assert pygame.display.get_surface() is None


def test_a_window_that_cannot_be_opened(monkeypatch, capsys):
    monkeypatch.setenv("SDL_VIDEODRIVER", "garbage")
    assert main(["play", TASK, "--size", "40"]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "window" in line]
    assert "garbage not available" in line
    assert "unset SDL_VIDEODRIVER" in line
    assert "--gif FILE" in line


def test_a_file_shows_what_the_environment_draws(tmp_path):
    path = tmp_path / "a.gif"
    line = ["--policy", "zero", "--look", "original", "--camera", "original", "--gif", str(path)]
    assert main(["play", TASK, *SHORT, "--seed", "3", *line]) == 0
    env = GymnasiumEnv(
        TASK,
        look="original",
        camera="original",
        render_mode="rgb_array",
        render_height=40,
        render_width=40,
    )
    env.reset(seed=3)
    for image in imageio.imread(path, index=None):
        # A GIF has 256 colors.
        assert np.abs(image.astype(float) - env.render()).mean() < 3
        env.step(np.zeros(1, np.float32))


def test_the_observation_is_its_newest_frame_enlarged(make_single):
    env = make_single(render_mode="rgb_array")
    first, second = islice(play.images(env, lambda obs: np.ones(1, np.float32), 0, 36), 2)
    assert second.shape == (36, 36, 3)
    env.reset(seed=0)
    obs, *_ = env.step(np.ones(1, np.float32))
    np.testing.assert_array_equal(second[1::3, 2::3], obs[..., 3:])
    np.testing.assert_array_equal(first[::3, ::3], obs[..., :3])


def test_ctrl_c_leaves_a_whole_file(tmp_path, monkeypatch):
    def interrupted(*args):
        yield from [np.zeros((8, 8, 3), np.uint8)] * 2
        raise KeyboardInterrupt

    monkeypatch.setattr(play, "images", interrupted)
    assert main(["play", TASK, *SHORT, "--gif", str(tmp_path / "a.gif")]) == 130
    assert imageio.imread(tmp_path / "a.gif", index=0).shape == (8, 8, 3)


def test_a_file_of_another_kind_is_told_first(capsys):
    assert main(["play", "ant", "--gif", "ant.png"]) == 1
    told = capsys.readouterr().err
    assert "one of .gif, .mp4, got 'ant.png'" in told
    assert "compiling" not in told


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (["antt"], "Did you mean 'ant'?"),
        (["ant", "--look", "origin"], "'original'"),
        (["reacher", "--policy", "pretrained"], "has no pretrained policy"),
        (["ant", "--size", "0"], "size must be a positive integer"),
        (["ant", "--num-frames", "0"], "num_frames must be a positive integer"),
    ],
)
def test_bad_input(line, told, capsys, tmp_path):
    assert main(["play", *line, "--gif", str(tmp_path / "a.gif")]) == 1
    assert told in capsys.readouterr().err
    assert not (tmp_path / "a.gif").exists()
