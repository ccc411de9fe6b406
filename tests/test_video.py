"""Videos and animated images come back from their files."""

from __future__ import annotations

import imageio.v3 as imageio
import numpy as np
import pytest

from pixelbrax_jax.video import write_frames

# imageio's pipes to ffmpeg are closed by the garbage collector.
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def flashes(count: int):
    """Frames that alternate between black and white."""
    for i in range(count):
        yield np.full((32, 48, 3), 255 * (i % 2), np.uint8)


@pytest.mark.parametrize("name", ["a.gif", "folder/a.mp4"])
def test_frames_come_back(tmp_path, name):
    path = write_frames(tmp_path / name, flashes(6), 20)
    read = imageio.imread(path, index=None)
    assert read.shape == (6, 32, 48, 3)
    np.testing.assert_allclose(read.mean((1, 2, 3)), [0, 255] * 3, atol=8)


def test_the_time_of_a_gif(tmp_path):
    path = write_frames(tmp_path / "a.gif", flashes(3), 20)
    assert imageio.immeta(path)["duration"] == 50, "milliseconds a frame"


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_what_came_before_ctrl_c_is_kept(tmp_path, name):
    def frames():
        yield from flashes(4)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_frames(tmp_path / name, frames(), 20)
    assert len(imageio.imread(tmp_path / name, index=None)) == 4


def test_another_suffix(tmp_path):
    with pytest.raises(ValueError, match=r"one of \.gif, \.mp4, got .*a\.webm"):
        write_frames(tmp_path / "a.webm", flashes(1), 20)
