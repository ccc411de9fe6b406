"""Which clips a folder has, and which of them belong to a split."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pixelbrax_jax.validation import check_choice, suggest

IMAGES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".webp"})
VIDEOS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".gif"})

_RESOLUTION = "480p"

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
    """One clip on disk.

    Attributes:
        name: of the clip.
        files: its images in order, or a single video file.
    """

    name: str
    files: tuple[Path, ...]

    @property
    def is_video(self) -> bool:
        """Whether it is a video file."""
        return self.files[0].suffix.lower() in VIDEOS


def find(folder: Path, split: str) -> list[Source]:
    """Return the clips of a split.

    A folder in DAVIS's layout has the splits ``"train"``, ``"test"`` (DAVIS's validation set),
    ``"paper-train"`` and ``"paper-test"``. Any other folder holds video files, or folders of
    images, in subfolders named like the splits; without subfolders all are in split ``"all"``.

    Args:
        folder: where to look; its subfolder ``DAVIS`` counts as well.
        split: of which clips.

    Returns:
        The clips, in the order of the split file, else by name.

    Raises:
        FileNotFoundError: the folder, a split file or a listed clip is missing; the message
            names it and the layout that was expected.
        ValueError: there is no such split, or it has no clips.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"there is no folder of clips at {folder}. {_DAVIS_LAYOUT}. Or give a folder with "
            "video files or folders of images; or clips='procedural', which needs no files."
            + suggest(folder, ["procedural"])
        )
    for root in (folder, folder / "DAVIS"):
        if (root / "JPEGImages").is_dir():
            return _davis(root, split)
    return _plain(folder, split)


def _davis(root: Path, split: str) -> list[Source]:
    check_choice(f"split of {root}", split, DAVIS_SPLITS)
    images = root / "JPEGImages" / _RESOLUTION
    if not images.is_dir():
        raise FileNotFoundError(f"{images} is missing. {_DAVIS_LAYOUT}.")
    if split in _PAPER:
        listed: Iterable[str] = _PAPER[split]
        where = f"split {split!r}"
    else:
        file = root / "ImageSets" / "2017" / ("train.txt" if split == "train" else "val.txt")
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


def _plain(folder: Path, split: str) -> list[Source]:
    # A folder of images is a clip; one that holds clips is a split; others do not matter.
    parts = [p.name for p in _entries(folder) if p.is_dir() and _holds_clips(p)]
    if parts and _holds_clips(folder):
        raise ValueError(
            f"{folder} has clips beside the folders {', '.join(parts)} that hold clips too; move "
            "them into a folder of their own."
        )
    check_choice(f"split of {folder}", split, parts or ["all"])
    home = folder / split if parts else folder
    sources = []
    for entry in _entries(home):
        if entry.is_dir() and _pictures(entry):
            sources.append(_sequence(entry))
        elif entry.suffix.lower() in VIDEOS:
            sources.append(Source(entry.stem, (entry,)))
    if not sources:
        kinds = ", ".join(sorted(VIDEOS))
        raise ValueError(f"{home} has neither videos ({kinds}) nor folders of images.")
    return sources


def _holds_clips(folder: Path) -> bool:
    return any(
        _pictures(entry) if entry.is_dir() else entry.suffix.lower() in VIDEOS
        for entry in _entries(folder)
    )


def _sequence(folder: Path) -> Source:
    files = _pictures(folder)
    if not files:
        kinds = ", ".join(sorted(IMAGES))
        raise ValueError(f"clip {folder} has no images ({kinds}); remove it or fill it.")
    return Source(folder.name, tuple(files))


def _pictures(folder: Path) -> list[Path]:
    return [p for p in _entries(folder) if p.suffix.lower() in IMAGES]


def _entries(folder: Path) -> list[Path]:
    """Return entries by name, 2 before 10; what begins with a dot is not meant."""
    return sorted(
        (p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: _natural(p.name)
    )


def _natural(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
