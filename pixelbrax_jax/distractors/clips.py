"""Banks of clips: from a folder, from a cache, or made on the spot."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.distractors import folders, procedural
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.types import Clips
from pixelbrax_jax.validation import check_choice, check_positive_int

MAX_BYTES = 2 * 1024**3
"""Device memory that a bank may take by default."""

_CACHE_VERSION = 1
"""Raised when the same files would give other pixels."""

_NOT_THE_USER = {"pixelbrax_jax", "pixelbrax_gym", "gymnasium", "stable_baselines3", "torchrl"}
"""Packages between a user's line and ``load_clips``."""


class ProceduralClipsWarning(UserWarning):
    """Procedural clips are in use, not DAVIS."""


@dataclass(frozen=True, eq=False)
class ClipBank:
    """Clips of one size, in host memory.

    Attributes:
        frames: (T, H, W, 3) uint8, all clips one after the other, row 0 at the top.
        length: (C,) int32, frames of each clip.
        names: of the clips.
        source: where they come from.
        split: which split they are.
    """

    frames: np.ndarray
    length: np.ndarray
    names: tuple[str, ...]
    source: str
    split: str

    def __post_init__(self) -> None:
        """Check that the parts agree.

        Raises:
            ValueError: they do not; the message says how.
        """
        shape, dtype = np.shape(self.frames), getattr(self.frames, "dtype", None)
        if len(shape) != 4 or shape[-1] != 3 or dtype != np.uint8:
            raise ValueError(f"frames must be (T, H, W, 3) uint8, got {shape} {dtype}.")
        length = np.asarray(self.length)
        if length.shape != (len(self.names),) or length.size == 0 or length.min() < 1:
            raise ValueError(f"length must have a number of at least 1 for each of {self.names}.")
        if length.sum() != shape[0]:
            raise ValueError(f"lengths add up to {length.sum()}, but there are {shape[0]} frames.")

    @cached_property
    def digest(self) -> str:
        """A hash of the content."""
        content = hashlib.sha256(repr((self.frames.shape, self.length.tolist())).encode())
        content.update(np.ascontiguousarray(self.frames).data)
        return content.hexdigest()

    @property
    def first(self) -> np.ndarray:
        """(C,) int32, index of each clip's first frame."""
        return np.concatenate([[0], np.cumsum(self.length)[:-1]]).astype(np.int32)

    @property
    def device_bytes(self) -> int:
        """Bytes that ``to_device`` takes: four for each pixel."""
        return int(self.frames.shape[0] * self.frames.shape[1] * self.frames.shape[2] * 4)

    def to_device(self) -> Clips:
        """Return the clips as ``EnvParams.clips`` wants them, on JAX's default device."""
        pixels = np.zeros((*self.frames.shape[:3], 4), np.uint8)
        pixels[..., :3] = self.frames
        return Clips(
            packed=jnp.asarray(pixels.view("<u4")[..., 0]),
            first=jnp.asarray(self.first),
            length=jnp.asarray(self.length, jnp.int32),
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

    Images are cut to the middle of the wanted proportions and scaled with an antialiasing
    filter. What was read once is cached on disk, under a name made from all that decides it.

    Args:
        source: a folder: DAVIS-2017, or videos, or folders of images; see
            ``folders.find``. ``"procedural"`` makes clips without any file; results with them
            are not results with DAVIS.
        split: of a DAVIS folder ``"train"``, ``"test"``, ``"paper-train"``, ``"paper-test"``; of
            procedural clips ``"train"``, ``"test"`` (other clips of the same families) and
            ``"ood"`` (other families); of another folder its subfolders, or ``"all"``.
        height: pixels.
        width: pixels.
        num_clips: how many of the split, the first ones; None means all.
        max_bytes: device memory that the bank may take.
        cache_dir: where to cache; None means ``$PIXELBRAX_CACHE``, else
            ``~/.cache/pixelbrax``.
        progress: whether a bar is shown while files are read, if tqdm is installed.

    Returns:
        The bank.

    Raises:
        FileNotFoundError: something is missing; the message names it and what was expected.
        ValueError: an unknown split, a file that cannot be read, or a clip without frames.
        MemoryError: the bank would be too large; the message says how to make it smaller.
        ImportError: Pillow or imageio is missing, with the fix.
    """
    height, width = check_positive_int("height", height), check_positive_int("width", width)
    if num_clips is not None:
        num_clips = check_positive_int("num_clips", num_clips)
    if str(source) == "procedural":
        check_choice("split of procedural clips", split, procedural.SPLITS)
        names = procedural.names(split)[:num_clips]
        _check_size(len(names) * procedural.FRAMES, height, width, max_bytes)
        return _procedural(tuple(names), split, height, width)
    folder = Path(source).expanduser().absolute()
    sources = folders.find(folder, split)[:num_clips]
    images = sum(len(s.files) for s in sources if not s.is_video)
    _check_size(images, height, width, max_bytes)
    home = _cache_home(cache_dir) / f"{_digest(sources, height, width)}.npz"
    frames, length = _read_cache(home) or _decode(sources, height, width, max_bytes, progress)
    _check_size(len(frames), height, width, max_bytes)
    _write_cache(home, frames, length)
    return ClipBank(frames, length, tuple(s.name for s in sources), str(folder), split)


@lru_cache(maxsize=8)
def _procedural(names: tuple[str, ...], split: str, height: int, width: int) -> ClipBank:
    frames = np.concatenate([procedural.clip(name, height, width) for name in names])
    frames.flags.writeable = False  # shared by all who ask
    length = np.full(len(names), procedural.FRAMES, np.int32)
    return ClipBank(frames, length, names, "procedural", split)


def warn_procedural() -> None:
    """Say, once for each place in the user's code, that these clips are not DAVIS."""
    warnings.warn(
        "the background plays procedural clips, as no clips= were given; results are not results "
        "on DAVIS. Say clips='procedural' if that is what you want, or clips='<folder of "
        "DAVIS-2017>'.",
        ProceduralClipsWarning,
        stacklevel=_stacklevel_of_the_user(),
    )


def _stacklevel_of_the_user() -> int:
    """Return what ``warnings.warn`` wants in the calling function to point at the user's own line.

    An environment is made at many depths: by ``make``, by Gymnasium's, by the class of a adapter.
    """
    level, frame = 1, sys._getframe(1)
    while frame.f_globals.get("__name__", "").partition(".")[0] in _NOT_THE_USER:
        if frame.f_back is None:
            return 1
        level, frame = level + 1, frame.f_back
    return level


def _check_size(frames: int, height: int, width: int, max_bytes: int) -> None:
    needed = frames * height * width * 4
    if needed > max_bytes:
        raise MemoryError(
            f"{frames} frames of {height} x {width} pixels take {needed / 1e6:.0f} MB on the "
            f"device, and max_bytes allows {max_bytes / 1e6:.0f} MB; take fewer clips "
            "(num_clips), smaller images, or load_clips(..., max_bytes=...)."
        )


def _decode(
    sources: list[folders.Source], height: int, width: int, max_bytes: int, progress: bool
) -> tuple[np.ndarray, np.ndarray]:
    clips: list[np.ndarray] = []
    total = 0
    for source in _with_progress(sources, progress):
        frames = _frames(source, height, width, max_bytes)
        if not frames:
            raise ValueError(f"{source.files[0]} has no frames; remove it.")
        clips.append(np.stack(frames))
        total += len(frames)
        _check_size(total, height, width, max_bytes)
    return np.concatenate(clips), np.array([len(clip) for clip in clips], np.int32)


def _with_progress(sources: list[folders.Source], progress: bool) -> Iterable[folders.Source]:
    if not progress:
        return sources
    try:
        from tqdm import tqdm
    except ImportError:
        return sources
    return tqdm(sources, desc="reading clips", unit="clip", leave=False)


def _frames(source: folders.Source, height: int, width: int, max_bytes: int) -> list[np.ndarray]:
    """Return the clip's frames at the wanted size."""
    if source.is_video:
        return _video_frames(source.files[0], height, width, max_bytes)
    with ThreadPoolExecutor() as pool:  # Pillow decodes and scales without Python's lock
        return list(pool.map(lambda file: _picture(file, height, width), source.files))


def _picture(file: Path, height: int, width: int) -> np.ndarray:
    try:
        with pillow().open(file) as image:
            return _fit(image.convert("RGB"), height, width)
    except OSError as error:
        raise ValueError(
            f"{file} cannot be read as an image ({error}); unpack it again."
        ) from error


def _video_frames(file: Path, height: int, width: int, max_bytes: int) -> list[np.ndarray]:
    try:
        import imageio.v3 as imageio
    except ImportError as error:
        raise ImportError(f"reading videos needs imageio; try: {install_extra('clips')}") from error
    image_module = pillow()
    with warnings.catch_warnings():
        # FFmpeg is started as a process of its own at once, which is safe beside JAX's threads.
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        frames: list[np.ndarray] = []
        try:
            for frame in imageio.imiter(file):
                image = image_module.fromarray(np.asarray(frame)).convert("RGB")
                frames.append(_fit(image, height, width))
                _check_size(len(frames), height, width, max_bytes)
            return frames
        except (OSError, RuntimeError, StopIteration) as error:
            raise ValueError(f"{file} cannot be read as a video ({error}).") from error


def _fit(image: Any, height: int, width: int) -> np.ndarray:
    """Return the middle of an image at the wanted proportions, scaled; (height, width, 3) uint8."""
    scale = min(image.width / width, image.height / height)
    across, down = round(scale * width), round(scale * height)
    left, top = (image.width - across) // 2, (image.height - down) // 2
    middle = image.crop((left, top, left + across, top + down))
    return np.asarray(middle.resize((width, height), pillow().Resampling.LANCZOS), np.uint8)


def pillow() -> Any:
    """Return Pillow's module of images.

    Raises:
        ImportError: it is missing, with the fix.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(f"reading images needs Pillow; try: {install_extra('clips')}") from error
    return Image


def _cache_home(given: str | Path | None) -> Path:
    home = given or os.environ.get("PIXELBRAX_CACHE") or Path.home() / ".cache" / "pixelbrax"
    return Path(home).expanduser() / "clips"


def _digest(sources: list[folders.Source], height: int, width: int) -> str:
    """Return a name for the content of these files at this size, wherever they lie."""
    digest = hashlib.sha256(json.dumps([_CACHE_VERSION, height, width]).encode())
    for source in sources:
        digest.update(json.dumps([source.name, len(source.files)]).encode())
        # One after the other: threads would wait for Python's lock longer than for a hash.
        for file in source.files:
            with file.open("rb") as opened:  # a video need not fit into memory
                digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()[:32]


def _read_cache(file: Path) -> tuple[np.ndarray, np.ndarray] | None:
    if not file.is_file():
        return None
    try:
        with file.open("rb") as opened, np.load(opened) as cached:
            return cached["frames"], cached["length"]
    except (EOFError, ValueError, KeyError, zipfile.BadZipFile):
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)  # damaged: it is made again
        return None
    except OSError:  # cannot be read now; the clips themselves can
        return None


def _write_cache(file: Path, frames: np.ndarray, length: np.ndarray) -> None:
    """Write beside and then rename: a half-written cache never has the name that is read."""
    if file.is_file():
        return
    half: Path | None = None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".tmp", delete=False) as opened:
            half = Path(opened.name)
            np.savez(opened, frames=frames, length=length)
        half.chmod(0o644)  # others may share the cache
        half.replace(file)
    except OSError as error:
        if half is not None:
            with contextlib.suppress(OSError):
                half.unlink(missing_ok=True)
        warnings.warn(
            f"clips could not be cached in {file.parent} ({error}).",
            stacklevel=_stacklevel_of_the_user(),
        )
