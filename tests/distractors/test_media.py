"""Images and videos as people have them become the frames that a player would show."""

from __future__ import annotations

import os
import subprocess
import warnings
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pixelbrax_jax import load_clips

RAMP = np.linspace(0, 255, 16).round().astype(np.uint8)


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "cache"))


def load(file: Path, height=16, width=16):
    """The frames of the clips in the folder of a file, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_clips(file.parent, "all", height=height, width=width, progress=False).frames


def read_image(tmp_path, name, save):
    """The frame of a clip with one image."""
    file = tmp_path / "clips" / "one" / name
    file.parent.mkdir(parents=True)
    save(file)
    (frame,) = load(file.parent)
    return frame


def ramp(scale=1, dtype=np.uint8):
    """16 x 16 gray, brighter to the right."""
    return np.tile((RAMP.astype(np.float64) * scale).astype(dtype), (16, 1))


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("8 bits.png", lambda: Image.fromarray(ramp())),
        ("16 bits.png", lambda: Image.fromarray(ramp(257, np.uint16))),
        ("16 bits.tif", lambda: Image.fromarray(ramp(257, np.uint16))),
        ("32 bits.tiff", lambda: Image.fromarray(ramp(257, np.int32))),
        ("floats.tif", lambda: Image.fromarray(ramp(1 / 255, np.float32))),
        ("palette.png", lambda: Image.fromarray(ramp()).convert("P")),
        ("palette.BMP", lambda: Image.fromarray(ramp()).convert("P")),
        ("ink.tif", lambda: Image.fromarray(ramp()).convert("RGB").convert("CMYK")),
        ("opaque.PNG", lambda: Image.fromarray(ramp()).convert("RGBA")),
        ("gray and alpha.png", lambda: Image.fromarray(ramp()).convert("LA")),
        ("ünï.webp", lambda: Image.fromarray(ramp()).convert("RGB")),
    ],
)
def test_every_kind_of_pixel_becomes_the_same_color(tmp_path, name, image):
    options = {"lossless": True} if name.endswith("webp") else {}
    frame = read_image(tmp_path, name, lambda file: image().save(file, **options))
    assert np.abs(frame.astype(int) - ramp()[..., None]).max() <= 1


def test_one_bit(tmp_path):
    image = Image.fromarray(ramp() > 127)
    frame = read_image(tmp_path, "a.png", lambda file: image.save(file))
    np.testing.assert_array_equal(frame[..., 0], (ramp() > 127) * 255)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_what_is_transparent_lies_on_black(tmp_path, mode):
    image = Image.new("RGBA", (16, 16), (200, 200, 200, 0))
    image.paste((200, 200, 200, 255), (0, 0, 8, 16))
    image.paste((200, 200, 200, 128), (0, 0, 8, 8))
    frame = read_image(tmp_path, "a.png", lambda file: image.convert(mode).save(file))
    assert frame[:, 10:].max() == 0
    assert np.abs(frame[10:, :6].astype(int) - 200).max() <= 2
    if mode != "P":
        assert np.abs(frame[:6, :6].astype(int) - 100).max() <= 2


def test_the_orientation_of_a_camera(tmp_path):
    image, exif = Image.fromarray(ramp()), Image.Exif()
    exif[0x0112] = 6  # a quarter turn clockwise
    frame = read_image(tmp_path, "a.png", lambda file: image.save(file, exif=exif))
    np.testing.assert_array_equal(frame[..., 0], ramp().T)


def test_images_thinner_than_a_pixel(tmp_path):
    def save(file):
        Image.new("RGB", (1, 100), "red").save(file)

    file = tmp_path / "clips" / "one" / "a.png"
    file.parent.mkdir(parents=True)
    save(file)
    assert load(file.parent, height=2, width=40)[0].reshape(-1, 3).tolist() == [[255, 0, 0]] * 80


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.png", b"", "it is empty"),
        ("a.jpg", b"\n<!DOCTYPE html><html>404</html>", "it is a web page"),
        ("a.jpg", b"not an image", "it is not an image"),
    ],
)
def test_what_is_no_image(tmp_path, name, content, why):
    with pytest.raises(ValueError, match=rf"one.{name} cannot be read as an image: {why}; get it"):
        read_image(tmp_path, name, lambda file: file.write_bytes(content))


@pytest.mark.parametrize(
    ("name", "image", "why"),
    [
        ("a.tif", Image.fromarray(ramp(1, np.float32)), r"\[0.0, 255.0\], not in \[0, 1\]"),
        ("a.tif", Image.fromarray(ramp(-1, np.int32)), r"\[-255, 0\], not in \[0, 65535\]"),
        (
            "a.tif",
            Image.fromarray(ramp(1, np.int32)),
            r"32-bit pixels are in \[0, 255\], .*may mean 8 bits",
        ),
    ],
)
def test_pixels_of_unknown_range(tmp_path, name, image, why):
    with pytest.raises(ValueError, match=rf"{why}; save it with 8 bits\.$"):
        read_image(tmp_path, name, lambda file: image.save(file))


def test_32_bits_of_nothing_are_black(tmp_path):
    image = Image.fromarray(ramp(0, np.int32))
    assert read_image(tmp_path, "a.tif", lambda file: image.save(file)).max() == 0


def test_several_images_in_one_file(tmp_path):
    image = Image.fromarray(ramp())
    with pytest.raises(ValueError, match=r"2 images instead of one; save each in a separate file"):
        read_image(
            tmp_path,
            "a.webp",
            lambda file: image.save(file, save_all=True, append_images=[image.transpose(0)]),
        )


@pytest.mark.parametrize("name", ["a.png", "a.gif"])
def test_more_pixels_than_pillow_takes(tmp_path, monkeypatch, name):
    file = tmp_path / "clips" / ("." if name == "a.gif" else "one") / name
    file.parent.mkdir(parents=True)
    Image.fromarray(ramp()).save(file)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    fix = "more than 200 pixels; scale it down, or raise PIL.Image.MAX_IMAGE_PIXELS"
    with pytest.raises(ValueError, match=rf"a\.... cannot be read as .*: it has {fix}\.$"):
        load_clips(tmp_path / "clips", "all", progress=False)


def test_too_little_memory_is_no_fault_of_the_file(tmp_path, monkeypatch):
    def convert(image, mode):
        raise MemoryError

    monkeypatch.setattr(Image.Image, "convert", convert)
    with pytest.raises(MemoryError):
        read_image(tmp_path, "a.bmp", lambda file: Image.fromarray(ramp()).save(file))


def ffmpeg(*arguments):
    """Make a video."""
    line = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *map(str, arguments)]
    subprocess.run(line, check=True)


PATTERN = ("-f", "lavfi", "-i", "testsrc=size=64x48:rate=10:duration=3")
SOUND = ("-f", "lavfi", "-i", "sine=duration=4")


def make(file: Path, *arguments) -> Path:
    """A video of 30 frames of 48 x 64, with every fifth one whole."""
    file.parent.mkdir(exist_ok=True)
    ffmpeg(*PATTERN, *arguments, "-g", "5", file)
    return file


@pytest.mark.parametrize("suffix", ["mp4", "mov", "avi", "mkv", "webm", "gif", "MP4"])
def test_every_container(tmp_path, suffix):
    assert len(load(make(tmp_path / "clips" / f"-ä: 1.{suffix}"))) == 30


def test_a_sound_that_is_longer(tmp_path):
    assert len(load(make(tmp_path / "clips" / "a.mp4", *SOUND))) == 30


def test_odd_sizes_and_rates_that_change(tmp_path):  # without a warning
    odd = ("-vf", "crop=63:47:exact=1,select='not(mod(n,3))'")
    frames = load(make(tmp_path / "clips" / "a.mp4", *odd, "-pix_fmt", "yuv444p"))
    assert 10 <= len(frames) <= 30, "as FFmpeg's release understands the rate"


def test_a_video_of_a_telephone_is_turned(tmp_path):
    upright = load(make(tmp_path / "upright" / "a.mp4"), 64, 64)
    (tmp_path / "turned").mkdir()
    turned = tmp_path / "turned" / "a.mp4"
    try:
        ffmpeg("-display_rotation", 90, "-i", tmp_path / "upright" / "a.mp4", "-c", "copy", turned)
    except subprocess.CalledProcessError:
        pytest.skip("an FFmpeg older than 6 cannot write a turned video")
    difference = load(turned, 64, 64).astype(int) - np.rot90(upright, axes=(1, 2))
    assert np.abs(difference).mean() < 1


@pytest.mark.parametrize("suffix", ["mp4", "avi", "mkv", "webm"])
@pytest.mark.parametrize("more", [(), SOUND])
def test_a_video_that_is_cut_short(tmp_path, suffix, more):
    whole = make(tmp_path / "whole" / f"a.{suffix}", *more, "-movflags", "faststart")
    file = tmp_path / "clips" / f"a.{suffix}"
    file.parent.mkdir()
    file.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    for _ in range(2):  # decoded, and from the cache
        with pytest.warns(
            UserWarning, match=rf"clips.a\.{suffix} declares (30|31|40) frames"
        ) as told:
            frames = load_clips(file.parent, "all", height=8, width=8).frames
        assert f"frames but has {len(frames)}" in str(told[0].message)
        assert 0 < len(frames) < 28


def test_a_gif_of_changes_and_one_that_is_cut_short(tmp_path):
    images = [Image.new("RGB", (16, 16), "red")]
    for column in range(8):
        images.append(images[-1].copy())
        images[-1].paste("lime", (column, 0, column + 1, 16))
    file = tmp_path / "clips" / "a.gif"
    file.parent.mkdir()
    images[0].save(file, save_all=True, append_images=images[1:])
    frames = load(file)
    np.testing.assert_array_equal(frames, np.stack([np.asarray(image) for image in images]))
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 7 // 10])
    with pytest.warns(UserWarning, match=r"a\.gif is cut short after \d frames; get it again"):
        assert len(load_clips(file.parent, "all", height=8, width=8).frames) < 9
    file.write_bytes(content[:-1])
    with pytest.warns(UserWarning, match="cut short after 9 frames"):
        load_clips(file.parent, "all", height=8, width=8)


def test_a_transparent_gif(tmp_path):
    images = [Image.new("RGBA", (16, 16), (0, 0, 255, 0)) for _ in range(3)]
    for column, image in enumerate(images):
        image.paste((255, 255, 0, 255), (column, 0, column + 1, 16))
    file = tmp_path / "clips" / "a.gif"
    file.parent.mkdir()
    images[0].save(file, save_all=True, append_images=images[1:], disposal=2)
    frames = load(file)
    for column, frame in enumerate(frames):
        assert frame[:, column].reshape(-1, 3).tolist() == [[255, 255, 0]] * 16
        assert np.delete(frame, column, axis=1).max() == 0


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.mp4", b"", "it is empty"),
        ("a.mp4", b"<!DOCTYPE html>\n<html>404</html>" * 9, "it is a web page"),
        ("a.gif", b"<html>", "it is a web page"),
        ("a.mp4", b"this is no video" * 99, ".+"),
        ("a.gif", b"this is no video", "it is not an image"),
        ("a.mp4", None, "it has only sound"),
    ],
)
def test_what_is_no_video_is_told_in_a_line(tmp_path, name, content, why):
    file = tmp_path / "clips" / name
    file.parent.mkdir()
    if content is None:
        ffmpeg(*SOUND, file)
    else:
        file.write_bytes(content)
    with pytest.raises(ValueError, match=f"cannot be read as a video: {why}; get it") as error:
        load(file)
    assert len(str(error.value)) < len(str(file)) + 120
    assert "\n" not in str(error.value)


def test_what_other_programs_leave_is_no_clip(tmp_path):
    file = make(tmp_path / "clips" / "a.mp4", "-frames:v", "3")
    for name in ("._a.mp4", ".DS_Store", "Thumbs.db", "notes.txt"):
        (file.parent / name).write_bytes(b"\0")
    (file.parent / "folder.mp4").mkdir()
    assert len(load(file)) == 3
    Image.new("RGB", (8, 8)).save(file.parent / "folder.mp4" / "0.png")
    (file.parent / "folder.mp4" / "1.png").mkdir()
    assert len(load(file)) == 4


def test_links(tmp_path):
    file = make(tmp_path / "elsewhere" / "a.mp4", "-frames:v", "3")
    link = tmp_path / "clips" / "b.mp4"
    link.parent.mkdir()
    link.symlink_to(file)
    assert len(load(link)) == 3
    file.unlink()
    with pytest.raises(FileNotFoundError, match=r"b\.mp4"):
        load(link)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may read anything")
@pytest.mark.parametrize("name", ["a.mp4", "folder"])
def test_what_may_not_be_read(tmp_path, name):
    file = make(tmp_path / "clips" / "a.mp4")
    (file.parent / "folder").mkdir()
    (file.parent / name).chmod(0)
    with pytest.raises(PermissionError, match=name):
        load(file)


def test_no_home(tmp_path, monkeypatch):
    make(tmp_path / "clips" / "a.mp4", "-frames:v", "3")
    for name in ("PIXELBRAX_CACHE", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", lambda uid: {}[uid])
    with pytest.warns(UserWarning, match=r"no home folder; set HOME.*\) and are decoded again"):
        bank = load_clips(tmp_path / "clips", "all", height=8, width=8)
    assert bank.length.tolist() == [3]
    with pytest.raises(FileNotFoundError, match="set HOME, or give the whole path"):
        load_clips("~/clips", "all")
    load_clips(tmp_path / "clips", "all", height=8, width=8, cache_dir=tmp_path / "named")
    assert list((tmp_path / "named").rglob("*.npz"))
