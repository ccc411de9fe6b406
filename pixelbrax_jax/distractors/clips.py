"""Banks of clips: from a folder, the cache or a procedure."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import warnings
import zipfile
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.cache import cache_folder
from pixelbrax_jax.distractors import folders, procedural
from pixelbrax_jax.distractors.media import AGAIN, read_clip
from pixelbrax_jax.paths import replacing, whole_path
from pixelbrax_jax.types import Clips
from pixelbrax_jax.validation import check_choice, check_positive_int

MAX_BYTES = 2 * 1024**3
"""Default limit of a bank's device memory."""

_CACHE_VERSION = 2
"""Increased when the same files give other pixels."""

_NOT_THE_USER = {
    "pixelbrax_jax",
    "pixelbrax_gym",
    "gymnasium",
    "stable_baselines3",
    "torchrl",
    "contextlib",
}
"""Packages between a user's code and ``load_clips``."""

_Decoded = tuple[np.ndarray, np.ndarray, list[str]]
"""Frames, lengths of the clips, and defects of their files."""


class ProceduralClipsWarning(UserWarning):
    """Procedural clips are in use instead of DAVIS."""


class OnlySplitWarning(UserWarning):
    """A folder has only one split, which is used for training."""


@dataclass(frozen=True, eq=False)
class ClipBank:
    """Clips of one size in host memory.

    Attributes:
        frames: (T, H, W, 3) uint8, all clips concatenated, row 0 at the top.
        length: (C,) int32, number of frames of each clip.
        names: names of the clips.
        source: folder or ``procedural``.
        split: name of the split.

    Raises:
        ValueError: the parts do not agree; the message says how.
    """

    frames: np.ndarray
    length: np.ndarray
    names: tuple[str, ...]
    source: str
    split: str

    def __post_init__(self) -> None:
        shape, dtype = np.shape(self.frames), getattr(self.frames, "dtype", None)
        if len(shape) != 4 or shape[-1] != 3 or dtype != np.uint8:
            raise ValueError(f"frames must be (T, H, W, 3) uint8, got {shape} {dtype}.")
        length = np.asarray(self.length)
        whole = length.dtype.kind in "iu" and length.shape == (len(self.names),)
        if not whole or length.size == 0 or length.min() < 1:
            raise ValueError(f"length must have a number of at least 1 for each of {self.names}.")
        if length.sum() != shape[0]:
            raise ValueError(f"lengths add up to {length.sum()}, but there are {shape[0]} frames.")
        object.__setattr__(self, "length", length.astype(np.int32))

    @cached_property
    def digest(self) -> str:
        """Hash of the content."""
        content = hashlib.sha256(repr((self.frames.shape, self.length.tolist())).encode())
        content.update(np.ascontiguousarray(self.frames).data)
        return content.hexdigest()

    @property
    def first(self) -> np.ndarray:
        """(C,) int32, index of each clip's first frame."""
        return np.concatenate([[0], np.cumsum(self.length)[:-1]]).astype(np.int32)

    @property
    def device_bytes(self) -> int:
        """Bytes that ``to_device`` takes: four per pixel."""
        return self.frames.size // 3 * 4

    def to_device(self) -> Clips:
        """Return ``EnvParams.clips``, on JAX's default device."""
        pixels = np.zeros((*self.frames.shape[:3], 4), np.uint8)
        pixels[..., :3] = self.frames
        return Clips(
            packed=jnp.asarray(pixels.view("<u4")[..., 0]),
            first=jnp.asarray(self.first),
            length=jnp.asarray(self.length),
        )


def load_clips(
    source: str | os.PathLike[str] = "procedural",
    split: str = "train",
    *,
    height: int = 84,
    width: int = 84,
    num_clips: int | None = None,
    max_bytes: int = MAX_BYTES,
    cache_dir: str | Path | None = None,
    progress: bool = True,
) -> ClipBank:
    """Return a bank of clips.

    Images are cropped to the center at the requested aspect ratio and scaled with an antialiasing
    filter; see ``media.read_clip`` for colors. Decoded clips are cached on disk. A warning names
    each file with fewer frames than it declares.

    Args:
        source: a folder with DAVIS-2017, videos or folders of images, see ``folders.find``; or
            ``"procedural"`` for generated clips, whose results are not comparable with DAVIS.
        split: of a DAVIS folder ``"train"``, ``"test"``, ``"paper-train"``, ``"paper-test"``; of
            procedural clips ``"train"``, ``"test"`` (other clips of the same families) and
            ``"ood"`` (other families); of another folder its subfolders, or ``"all"``. If a folder
            has only one split, ``"train"`` selects it, with an ``OnlySplitWarning``; for a test on
            the same clips, use the split's name.
        height: pixels.
        width: pixels.
        num_clips: number of clips, from the first; None means all.
        max_bytes: limit of the bank's device memory.
        cache_dir: cache folder; None means ``$PIXELBRAX_CACHE``, else ``~/.cache/pixelbrax``.
        progress: whether a terminal shows a progress bar, if tqdm is installed.

    Raises:
        FileNotFoundError: something is missing; the message says what was expected.
        ValueError: the split is unknown, a file cannot be read, or a clip has no frames.
        MemoryError: the bank is too large; the message has the fix.
        ImportError: Pillow or imageio-ffmpeg is missing; the message has the fix.
    """
    height, width = check_positive_int("height", height), check_positive_int("width", width)
    if num_clips is not None:
        num_clips = check_positive_int("num_clips", num_clips)
    if str(source) == "procedural":
        check_choice("split of procedural clips", split, procedural.SPLITS)
        names = procedural.names(split)[:num_clips]
        _check_size(len(names) * procedural.FRAMES, height, width, max_bytes)
        return _procedural(tuple(names), split, height, width)
    folder = whole_path(source)
    sources, present = folders.find(folder, split)
    if present != split:
        _warn(
            f"split={split!r} selects {present!r}, the only split of {folder}, which has no clips "
            f"to test on. Pass split={present!r} if that is what you want, or put the clips "
            "into subfolders train and test.",
            OnlySplitWarning,
        )
    sources = sources[:num_clips]
    images = sum(len(s.files) for s in sources if not s.is_video)
    _check_size(images, height, width, max_bytes)
    cached = Path("clips", f"{_digest(sources, height, width)}.npz")
    clips = _read_cache(cache_dir, cached)
    if clips is None:
        clips = _decode(sources, height, width, max_bytes, progress)
        _write_cache(cache_dir, cached, clips)
    frames, length, lacks = clips
    _check_size(len(frames), height, width, max_bytes)
    for clip, lack in zip(sources, lacks, strict=True):
        if lack:
            _warn(f"{clip.files[0]} {lack}; {AGAIN}.")
    return ClipBank(frames, length, tuple(s.name for s in sources), str(folder), present)


@lru_cache(maxsize=8)
def _procedural(names: tuple[str, ...], split: str, height: int, width: int) -> ClipBank:
    frames = np.concatenate([procedural.clip(name, height, width) for name in names])
    frames.flags.writeable = False  # shared by all callers
    length = np.full(len(names), procedural.FRAMES, np.int32)
    return ClipBank(frames, length, names, "procedural", split)


def warn_procedural() -> None:
    """Warn, once per place in the user's code, that clips are not DAVIS."""
    _warn(
        "the background plays procedural clips, because clips= is not given; results are not "
        "comparable with DAVIS. Pass clips='procedural' if that is what you want, or "
        "clips='<folder of DAVIS-2017>'.",
        ProceduralClipsWarning,
    )


def _warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn with the line of the user's code."""
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals["__name__"].partition(".")[0] in _NOT_THE_USER:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def _check_size(frames: int, height: int, width: int, max_bytes: int) -> None:
    needed = frames * height * width * 4
    if needed > max_bytes:
        raise MemoryError(
            f"{frames} frames of {height} x {width} pixels take {needed / 1e6:.0f} MB on the "
            f"device, and max_bytes allows {max_bytes / 1e6:.0f} MB; use fewer clips "
            "(num_clips), smaller images, or load_clips(..., max_bytes=...)."
        )


def _decode(
    sources: list[folders.Source], height: int, width: int, max_bytes: int, progress: bool
) -> _Decoded:
    clips: list[np.ndarray] = []
    lacks: list[str] = []

    def check_count(count: int) -> None:
        _check_size(sum(map(len, clips)) + count, height, width, max_bytes)

    with contextlib.suppress(ImportError):
        from tqdm import tqdm

        # None hides the bar if standard error is not a terminal.
        hidden = None if progress else True
        sources = tqdm(sources, "reading clips", unit="clip", leave=False, disable=hidden)
    for source in sources:
        frames, lack = read_clip(source, height, width, check_count)
        clips.append(np.stack(frames))
        lacks.append(lack)
    return np.concatenate(clips), np.array([len(clip) for clip in clips], np.int32), lacks


def _digest(sources: list[folders.Source], height: int, width: int) -> str:
    """Return a hash of the files' content and the size, independent of their folder."""
    digest = hashlib.sha256(json.dumps([_CACHE_VERSION, height, width]).encode())
    for source in sources:
        digest.update(json.dumps([source.name, len(source.files)]).encode())
        # Sequential, because threads would wait longer for Python's lock than for a hash.
        for file in source.files:
            with file.open("rb") as opened:  # a video need not fit into memory
                digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()[:32]


def _read_cache(cache_dir: str | Path | None, name: Path) -> _Decoded | None:
    # A damaged or unreadable file counts as missing.
    try:
        file = cache_folder(cache_dir) / name
        with file.open("rb") as opened, np.load(opened) as cached:
            return cached["frames"], cached["length"], cached["lacks"].tolist()
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        return None


def _write_cache(cache_dir: str | Path | None, name: Path, clips: _Decoded) -> None:
    frames, length, lacks = clips
    try:
        file = cache_folder(cache_dir) / name
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as part:
            np.savez(part, frames=frames, length=length, lacks=np.array(lacks, str))
    except OSError as error:
        _warn(
            f"clips could not be cached ({error}) and are decoded again each time; set the "
            "environment variable PIXELBRAX_CACHE to a folder."
        )
