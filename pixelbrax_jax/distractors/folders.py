"""Clips and splits of a folder."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pixelbrax_jax.validation import check_choice, suggest

IMAGES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff"})
VIDEOS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".gif"})

_RESOLUTION = "480p"

ALL = "all"
"""Split of a folder without subfolders."""

_FOR_TESTS = frozenset({"test", "val", "valid", "validation", "eval", "evaluation", "ood"})
"""Names of test splits, which are never used for training by default."""

# The split of the original PixelBrax, arXiv 2502.00021. It mixes DAVIS's own two.
_PAPER = {
    "paper-train": ("bear", "bike-packing"),
    "paper-test": (
        "blackswan",
        "bmx-bumps",
        "bmx-trees",
        "boat",
        "boxing-fisheye",
        "breakdance",
    ),
}

DAVIS_SPLITS = ("train", "test", *_PAPER)

_DAVIS_LAYOUT = (
    "DAVIS-2017 at 480p unpacks into JPEGImages/480p/<clip>/00000.jpg and "
    "ImageSets/2017/{train,val}.txt; get it from https://davischallenge.org/davis2017/code.html"
)


@dataclass(frozen=True)
class Source:
    """One clip on disk: its name, and its images in order or a single video file."""

    name: str
    files: tuple[Path, ...]

    @property
    def is_video(self) -> bool:
        """Whether it is a video file."""
        return self.files[0].suffix.lower() in VIDEOS


def find(folder: Path, split: str) -> tuple[list[Source], str]:
    """Return the clips of a split, and the split's name.

    A folder in DAVIS's layout (or any of its folders) has the splits ``"train"``, ``"test"``
    (DAVIS's validation set), ``"paper-train"`` and ``"paper-test"``. Any other folder has video
    files, or folders of images, in subfolders named like the splits; without subfolders all are in
    split ``"all"``. If there is only one split and its name is not that of a test, ``"train"`` also
    selects it. Clips are in the order of the split file, else by name.
    """
    if folder.is_file():
        raise FileNotFoundError(f"clips must be a folder, but {folder} is a file; give its folder.")
    if not folder.is_dir():
        raise FileNotFoundError(
            f"there is no folder of clips at {folder}. {_DAVIS_LAYOUT}. Or give a folder with "
            "video files or folders of images; or clips='procedural', which needs no files."
            + suggest(folder.name, ["procedural"])
        )
    images = _davis_images(folder)
    if images is None:
        return _plain(folder, split)
    return _davis(images, split), split


def _davis_images(folder: Path) -> Path | None:
    """Return the folder of DAVIS's clips for any of its folders, else None."""
    for root in (folder, folder / "DAVIS"):
        if (root / "JPEGImages").is_dir():
            return root / "JPEGImages" / _RESOLUTION
    # Other benchmarks take the folder of the images; any part of the path may be a link.
    for part in (Path(os.path.abspath(folder)), folder.resolve()):  # noqa: PTH100  # keeps links
        for images in (part, part / _RESOLUTION):
            if images.parent.name == "JPEGImages" and _lists(images).is_dir() and images.is_dir():
                return images
    return None


def _lists(images: Path) -> Path:
    return images.parents[1] / "ImageSets" / "2017"


def _davis(images: Path, split: str) -> list[Source]:
    check_choice(f"split of {images.parents[1]}", split, DAVIS_SPLITS)
    if not images.is_dir():
        raise FileNotFoundError(f"{images} is missing. {_DAVIS_LAYOUT}.")
    if split in _PAPER:
        listed: Iterable[str] = _PAPER[split]
        where = f"split {split!r}"
    else:
        file = _lists(images) / ("train.txt" if split == "train" else "val.txt")
        if not file.is_file():
            raise FileNotFoundError(f"the split file {file} is missing. {_DAVIS_LAYOUT}.")
        listed = file.read_text("utf-8").split()
        where = str(file)
    sources = []
    for name in listed:
        if not (images / name).is_dir():
            raise FileNotFoundError(
                f"clip {name!r}, listed in {where}, has no folder {images / name}; unpack "
                "the archive again."
            )
        sources.append(_sequence(images / name))
    if not sources:
        raise ValueError(f"{where} lists no clips.")
    return sources


def _plain(folder: Path, split: str) -> tuple[list[Source], str]:
    # A folder of images is a clip; a folder of clips is a split; other folders are ignored.
    parts = {p.name: found for p in _entries(folder) if p.is_dir() and (found := _clips(p))}
    clips = _clips(folder)
    if parts and clips:
        raise ValueError(
            f"{folder} has clips next to the folders {', '.join(parts)}, which also have clips; "
            "move them into a separate folder."
        )
    flat = {clip.name.lower(): clip.name for clip in clips if clip.is_dir()}
    # `train` alone may be a clip: DAVIS has one of this name.
    if "train" in flat and not _FOR_TESTS.isdisjoint(flat):
        names = [flat[name] for name in ("train", *sorted(_FOR_TESTS)) if name in flat]
        raise ValueError(
            f"{folder} has images directly in {', '.join(names)}, and a folder of images is one "
            f"clip: put each clip into a folder of its own, such as {names[0]}/clip/00000.jpg."
        )
    if not parts and not clips:
        kinds = ", ".join(sorted(VIDEOS))
        own = "; it has images itself, so give the folder above it" if _pictures(folder) else ""
        raise ValueError(f"{folder} has neither videos ({kinds}) nor folders of images{own}.")
    present = _present(folder, split, list(parts) or [ALL])
    return [
        _sequence(clip) if clip.is_dir() else Source(clip.stem, (clip,))
        for clip in (parts[present] if parts else clips)
    ], present


def _present(folder: Path, split: str, splits: list[str]) -> str:
    if split not in splits and len(splits) == 1:
        (only,) = splits
        if split == "train" and only.lower() not in _FOR_TESTS:
            return only
        raise ValueError(
            f"{folder} has no split {split!r}, only {only!r}; for more than one, put the clips "
            "into subfolders named like the splits, such as train and test."
        )
    return check_choice(f"split of {folder}", split, splits)


def _clips(folder: Path) -> list[Path]:
    return [
        entry
        for entry in _entries(folder)
        if (_pictures(entry) if entry.is_dir() else entry.suffix.lower() in VIDEOS)
    ]


def _sequence(folder: Path) -> Source:
    files = _pictures(folder)
    if not files:
        kinds = ", ".join(sorted(IMAGES))
        raise ValueError(f"clip {folder} has no images ({kinds}); remove it or fill it.")
    return Source(folder.name, tuple(files))


def _pictures(folder: Path) -> list[Path]:
    return [p for p in _entries(folder) if p.suffix.lower() in IMAGES and not p.is_dir()]


def _entries(folder: Path) -> list[Path]:
    """Return entries in natural order (2 before 10), without hidden ones."""
    return sorted(
        (p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: _natural(p.name)
    )


def _natural(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
