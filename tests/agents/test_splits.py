"""What an evaluation plays is what its split is called, whatever folders and names say."""

from __future__ import annotations

import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from pixelbrax_jax.agents.on_policy.ppo import PPOConfig
from pixelbrax_jax.agents.runner.settings import clip_digests
from pixelbrax_jax.agents.runner.splits import NoSplitError, make_split, make_splits, splits_of
from pixelbrax_jax.distractors import folders
from pixelbrax_jax.distractors.clips import load_clips

SIZE = {"height": 18, "width": 18}


@pytest.fixture(autouse=True)
def _cache(monkeypatch, tmp_path):
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "cache"))


def write_clips(folder: Path, names: str) -> Path:
    """Clips of two images each; those of one name are equal wherever they lie."""
    for name in names:
        (folder / name).mkdir(parents=True)
        for i in range(2):
            pixels = np.random.default_rng(ord(name) + i).integers(0, 256, (18, 18, 3), np.uint8)
            imageio.imwrite(folder / name / f"{i}.png", pixels)
    return folder


def config(
    clips: Path | str | None, split: str = "train", distractors: str = "video", **settings: object
) -> PPOConfig:
    return PPOConfig().replace(
        distractors=distractors,
        clips=None if clips is None else str(clips),
        split=split,
        **{"task": "inverted_pendulum"} | settings,
        **SIZE,
    )


def digests(clips: Path | str, split: str) -> list[str]:
    return clip_digests(load_clips(clips, split, **SIZE, progress=False).to_device())


def shown(made) -> list[str]:
    return clip_digests(made[1].clips)


@pytest.mark.parametrize(("split", "held_out"), [("train", "test"), ("paper-train", "paper-test")])
def test_a_run_is_evaluated_on_its_own_split_and_on_the_held_out_one(split, held_out, tmp_path):
    clips = "procedural"
    if split == "paper-train":
        images = tmp_path / "JPEGImages" / "480p"
        names = [name for part in ("paper-train", "paper-test") for name in folders._PAPER[part]]
        for letter, name in zip("abcdefgh", names, strict=True):
            write_clips(images, letter).joinpath(letter).rename(images / name)
        clips = tmp_path
    made = dict(make_splits(config(clips, split)))
    assert list(made) == ["clean", "train", "test"]
    assert shown(made["train"]) == digests(clips, split)
    assert shown(made["test"]) == digests(clips, held_out)
    assert made["clean"][1].clips is None
    assert made["clean"][0].distractors == ()


@pytest.mark.parametrize("split", ["all", "day"])
def test_clips_of_training_are_no_test(split, tmp_path):
    folder = write_clips(tmp_path / "clips" / ("" if split == "all" else split), "ab").parents[0]
    folder = tmp_path / "clips" if split == "all" else folder
    lines = []
    made = dict(make_splits(config(folder, split), report=lines.append))
    assert list(made) == ["clean", "train"]
    (line,) = lines
    assert f"no split 'test': training uses 2 of the 2 clips of split {split!r} of {folder}" in line
    with pytest.raises(NoSplitError, match="choose other clips with --clips"):
        dict(make_splits(config(folder, split), ["test"]))


def test_the_test_split_of_a_folder_must_have_other_clips(tmp_path):
    write_clips(tmp_path / "train", "abc")
    lines = []
    assert "test" not in dict(make_splits(config(tmp_path), report=lines.append))
    assert lines[0].startswith("no split 'test': ")
    write_clips(tmp_path / "test", "cd")
    with pytest.raises(NoSplitError, match="training uses 1 of the 2 clips of split 'test'"):
        make_split(config(tmp_path), "test")
    shutil.rmtree(tmp_path / "test" / "c")
    assert shown(make_split(config(tmp_path), "test")) == digests(tmp_path, "test")


def test_clips_of_another_folder_are_those_of_training_by_their_content(tmp_path):
    trained = digests(write_clips(tmp_path / "there", "ab"), "all")
    write_clips(tmp_path / "copy", "ab")
    write_clips(tmp_path / "others", "cd")
    of_run = config(tmp_path / "there", "all")
    here = of_run.replace(clips=str(tmp_path / "copy"))
    assert shown(make_split(here, "train", trained)) == trained
    with pytest.raises(NoSplitError, match="training uses 2 of the 2"):
        make_split(here, "test", trained)
    here = of_run.replace(clips=str(tmp_path / "others"))
    assert shown(make_split(here, "test", trained)) == digests(tmp_path / "others", "all")
    with pytest.raises(NoSplitError, match="others differ from those of the training"):
        make_split(here, "train", trained)


def test_without_clips_nothing_is_held_out():
    colors = config(None, distractors="color")
    assert splits_of(colors) == ("clean", "train")
    with pytest.raises(ValueError, match=r"needs clips or test_dynamics, .*; its splits: 'clean'"):
        make_split(colors, "test")
    assert splits_of(config("procedural", distractors="dcs-easy")) == ("clean", "train", "test")


def test_varied_dynamics_have_splits():
    plain = config(None, task="gym_hopper").replace(distractors=())
    assert splits_of(plain) == ("clean",)
    varied = plain.replace(dynamics="mass=2", test_dynamics="mass=3:4")
    assert splits_of(varied) == ("clean", "train", "test")
    ranges = [params.dynamics for _, (_, params) in make_splits(varied)]
    assert ranges[0] is None
    assert [list(r.mass) for r in ranges[1:]] == [[2, 2], [3, 4]]
    with pytest.raises(ValueError, match="needs distractors or dynamics, but the run has none"):
        make_split(plain, "train")


def test_a_folder_that_is_elsewhere_is_told_with_the_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=rf"folder with --clips: .* at {tmp_path}/clips\."):
        make_split(config("clips"), "train")
    write_clips(tmp_path / "clips" / "train", "a")
    with pytest.raises(NoSplitError, match=f"^{tmp_path}/clips has no split 'test'"):
        make_split(config("clips"), "test")
