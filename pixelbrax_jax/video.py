"""Video and GIF files."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.ffmpeg import encoder, find_ffmpeg
from pixelbrax_jax.paths import make_file

SUFFIXES = (".gif", ".mp4")

_LONGEST = 655_350
"""Longest display time of a GIF's image in milliseconds: hundredths of a second, in 16 bits."""
_SHORTEST = 20
"""Shortest time in milliseconds; viewers take less for a tenth of a second."""

NO_WRITER = f"a video needs imageio-ffmpeg and Pillow; try: {install_extra('video')}"


def write_frames(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> Path:
    """Write frames, (H, W, 3) uint8 of one size, to a video file as they arrive; return its path.

    The file is an ``.mp4``, which repeats the last row or column of an odd side, or a ``.gif``,
    which loops forever. Folders are created. After an error or Ctrl-C the earlier frames are kept.
    """
    path = Path(path)
    check_suffix(path)
    if not 0 < fps < math.inf:
        raise ValueError(f"fps must be a positive number, got {fps!r}.")
    try:
        if path.suffix.lower() == ".gif":
            import PIL.Image  # noqa: F401

            writer = _gif
        else:
            find_ffmpeg()
            writer = encoder
    except ImportError as error:
        raise ImportError(NO_WRITER) from error
    path = make_file("a video", path)  # before anything is rendered
    try:
        frames = iter(frames)
        first = next(frames, None)
        if first is None:
            raise ValueError(f"{path} was not written: there are no frames.")
        _check_frame(first, np.shape(first))
        with writer(path, fps) as append:
            for frame in chain([first], frames):
                _check_frame(frame, first.shape)
                append(frame)
    finally:
        if path.exists() and path.stat().st_size == 0:
            path.unlink()
    return path


def check_suffix(path: Path) -> None:
    """Raise a ValueError unless a video can be written to a file of this name."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"a video must be one of {', '.join(SUFFIXES)}, got {str(path)!r}.")


def _check_frame(frame: np.ndarray, first: tuple[int, ...]) -> None:
    shape, dtype = np.shape(frame), getattr(frame, "dtype", None)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape or dtype != np.uint8:
        raise ValueError(f"a frame must be (H, W, 3) uint8, got {shape} {dtype}.")
    if shape != first:
        raise ValueError(f"all frames must be of one size, got {shape} after {first}.")


@contextlib.contextmanager
def _gif(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    from PIL import Image

    images: list[Any] = []
    times: list[int] = []
    count = shown = 0
    last: Any = None

    def append(frame: np.ndarray) -> None:
        nonlocal count, shown, last
        count += 1
        # A GIF counts hundredths of a second. Rounded one by one, they would not add up.
        end = 10 * round(100 * count / fps)
        image, time = Image.fromarray(frame), end - shown
        if time < _SHORTEST:
            last = image
            return
        shown = end
        # Older releases of Pillow lose the time of equal images; newer ones add it up.
        still = bool(images) and image == images[-1]
        if still:
            time += times[-1]
        if time > _LONGEST:
            raise ValueError(
                f"{path} is incomplete: a GIF shows an image for at most {_LONGEST / 1000:.0f} s, "
                "and equal frames last longer; write an .mp4, or raise fps."
            )
        if still:
            times[-1] = time
        else:
            images.append(image)
            times.append(time)

    try:
        yield append
    finally:
        if images or last:
            _save_gif(path, images or [last], times or [_SHORTEST])


def _save_gif(path: Path, images: list[Any], times: list[int]) -> None:
    first, *others = images
    moving = {"save_all": True, "duration": times if others else times[0], "loop": 0}
    try:
        first.save(path, format="GIF", append_images=others, **moving)
    except BaseException as error:
        path.unlink(missing_ok=True)  # incomplete; nothing shows it
        # A side or a time exceeds 16 bits.
        if isinstance(error, (OSError, struct.error)):
            raise OSError(f"{path} was not written: {error}.") from error
        raise
