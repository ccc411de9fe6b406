"""Videos and animated images come back from their files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image

from pixelbrax_jax.ffmpeg import find_ffmpeg
from pixelbrax_jax.video import write_frames

ROOT = Path(__file__).parents[1]

# imageio's pipes to ffmpeg, with which tests read, are closed by the garbage collector.
pytestmark = [
    pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning"),
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def flashes(count: int, height: int = 32, width: int = 48):
    """Frames that alternate between black and white."""
    for i in range(count):
        yield np.full((height, width, 3), 255 * (i % 2), np.uint8)


@pytest.mark.parametrize("name", ["a.gif", "folder/a.mp4", "A.MP4", "-ä b.mp4", "12:30.gif"])
def test_frames_come_back(tmp_path, name):
    path = write_frames(tmp_path / name, flashes(6), 20)
    read = imageio.imread(path, index=None)
    assert read.shape == (6, 32, 48, 3)
    np.testing.assert_allclose(read.mean((1, 2, 3)), [0, 255] * 3, atol=8)


@pytest.mark.parametrize("fps", [30, 40, 60, 125])
def test_a_gif_lasts_as_long_as_its_frames(tmp_path, fps):
    """Rates at which a frame is no whole number of hundredths of a second."""
    path = write_frames(tmp_path / "a.gif", flashes(30), fps)
    times = []
    with Image.open(path) as image:
        for index in range(image.n_frames):
            image.seek(index)
            times.append(image.info["duration"])
    assert sum(times) == pytest.approx(30_000 / fps, abs=25)
    assert min(times) >= 20


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


@pytest.mark.parametrize(("height", "width"), [(45, 45), (1, 1), (4, 7), (46, 2)])
def test_odd_sides_are_padded_with_their_last_pixels(tmp_path, height, width):
    frame = np.zeros((height, width, 3), np.uint8)
    frame[-1:, -1:] = 255
    path = write_frames(tmp_path / "a.mp4", [frame] * 10, 25)
    read = imageio.imread(path, index=None)
    assert read.shape == (10, height + height % 2, width + width % 2, 3)
    assert read[:, -1, -1].min() > 200
    if height > 2:
        assert read[:, 0, 0].max() < 30
    still = imageio.imread(write_frames(tmp_path / "a.gif", [frame] * 10, 25), index=0)
    assert still.shape == frame.shape


def test_a_gif_of_less_than_its_shortest_time_shows_its_frame_that_long(tmp_path):
    path = tmp_path / "a.gif"
    path.write_bytes(b"an older file")
    write_frames(path, [np.full((8, 8, 3), 255, np.uint8)], 100)
    assert imageio.imread(path, index=0)[0, 0, 0] == 255
    assert imageio.immeta(path)["duration"] == 20, "milliseconds"


def test_a_still_gif_lasts_as_long(tmp_path):
    path = write_frames(tmp_path / "a.gif", [np.zeros((8, 8, 3), np.uint8)] * 10, 25)
    assert imageio.immeta(path)["duration"] == 400, "milliseconds"


def test_a_gif_that_stands_still_for_longer_than_it_can_say(tmp_path):
    dark, bright = np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 255, np.uint8)
    path = tmp_path / "a.gif"
    write_frames(path, [bright] + [dark] * 655 + [bright] * 655, 1)
    with pytest.raises(ValueError, match=r"a\.gif is incomplete: .* at most 655 s.*write an \.mp4"):
        write_frames(path, [bright] + [dark] * 656, 1)
    read = imageio.imread(path, index=None)
    assert read[:, 0, 0, 0].tolist() == [255, 0], "what came before is kept"
    with pytest.raises(ValueError, match="raise fps"):
        write_frames(tmp_path / "b.gif", [dark], 0.001)
    assert not (tmp_path / "b.gif").exists()


def test_a_gif_that_is_too_wide(tmp_path):
    with pytest.raises(OSError, match=r"a\.gif was not written: .*65535"):
        write_frames(tmp_path / "a.gif", flashes(2, 1, 65_536), 20)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_no_part_of_a_gif_is_left(tmp_path, monkeypatch, error):
    def save(image, path, **options):
        path.write_bytes(b"GIF89a")
        raise error

    monkeypatch.setattr("PIL.Image.Image.save", save)
    with pytest.raises(error):
        write_frames(tmp_path / "a.gif", flashes(2), 20)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
@pytest.mark.parametrize(
    ("frames", "fps", "message"),
    [
        ([], 20, "there are no frames"),
        ([np.zeros((4, 4), np.uint8)], 20, r"\(H, W, 3\) uint8, got \(4, 4\)"),
        ([np.zeros((4, 4, 3))], 20, r"\(H, W, 3\) uint8, got .* float64"),
        (flashes(1), 0, "fps must be a positive number, got 0"),
        (flashes(1), float("nan"), "fps must be a positive number, got nan"),
    ],
)
def test_nothing_is_left_of_what_cannot_be_written(tmp_path, suffix, frames, fps, message):
    with pytest.raises(ValueError, match=message):
        write_frames(tmp_path / f"a{suffix}", frames, fps)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_sizes_may_not_change(tmp_path, name):
    with pytest.raises(ValueError, match=r"one size, got \(4, 4, 3\) after \(32, 48, 3\)"):
        write_frames(tmp_path / name, [*flashes(3), *flashes(1, 4, 4)], 20)
    assert len(imageio.imread(tmp_path / name, index=None)) == 3


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_what_cannot_be_opened_is_told_before_a_frame_is_drawn(tmp_path, name):
    def frames():
        pytest.fail("drawn")
        yield

    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=r"must be a file, but .* is a folder"):
        write_frames(tmp_path / name, frames(), 20)


def test_the_encoder_speaks_in_one_line(tmp_path, capfd):
    with pytest.raises(OSError, match="invalid width x height") as error:
        write_frames(tmp_path / "a.mp4", flashes(2, 16, 20_000), 20)
    assert str(error.value).count("\n") == 0
    assert capfd.readouterr().err == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is one of Linux")
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_a_disk_that_is_full(tmp_path, name):
    code = f"""
import resource, signal, sys
import numpy as np
from pixelbrax_jax.video import write_frames
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
noise = np.random.default_rng(0).integers(0, 256, (60, 64, 64, 3), np.uint8)
try:
    write_frames({name!r}, noise, 25)
except OSError as error:
    sys.exit(f"told: {{error}}")
"""
    environ = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environ, capture_output=True, text=True
    )
    assert done.stderr.startswith(f"told: {name} was not written: ")
    assert "File too large" in done.stderr or "ended by SIGXFSZ" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_encoder_that_is_nowhere(tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nowhere/ffmpeg")
    with pytest.raises(OSError, match=r"IMAGEIO_FFMPEG_EXE is '/nowhere/ffmpeg'.*unset it"):
        write_frames(tmp_path / "a.mp4", flashes(1), 20)
    write_frames(tmp_path / "a.gif", flashes(1), 20)


def test_videos_are_h264(tmp_path):
    path = write_frames(tmp_path / "a.mp4", flashes(2), 20)
    look = subprocess.run([find_ffmpeg(), "-i", path], capture_output=True, text=True)
    assert "Video: h264" in look.stderr
    assert "yuv420p" in look.stderr


@pytest.mark.skipif(os.name != "posix", reason="a script of the shell")
def test_an_encoder_without_h264(tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    says = "echo \"Unknown encoder 'libx264'\" >&2; exit 1"
    program.write_text(f'#!/bin/sh\ncase "$*" in *libx264*) {says}; esac\n')
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(OSError, match=r"a\.mp4 was not written: Unknown encoder 'libx264'\.$"):
        write_frames(tmp_path / "a.mp4", flashes(1), 20)
    assert not (tmp_path / "a.mp4").exists()
