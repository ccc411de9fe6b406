"""Video and GIF files."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.ffmpeg import Decoder, Encoder

SUFFIXES = (".gif", ".mp4")

_LONGEST = 655_350.0
"""Longest display time of a GIF's image in milliseconds: hundredths of a second, in 16 bits."""

NO_WRITER = f"a video needs imageio-ffmpeg and Pillow; try: {install_extra('video')}"


def write_frames(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> Path:
    """Write frames to a video file as they arrive, and read the file back to check it.

    An MP4 repeats the last row or column of an odd side. After an error or Ctrl-C the file keeps
    the frames before it.

    Args:
        path: the file, ``.mp4`` or ``.gif`` (which loops forever); folders are created.
        frames: (H, W, 3) uint8 each, all of one size.
        fps: frames per second.

    Returns:
        The path.

    Raises:
        ValueError: the suffix is unknown, ``fps`` is not positive, there are no frames, a frame has
            another shape or dtype, or a GIF would show one image for more than 655 s.
        ImportError: imageio-ffmpeg or Pillow is not installed; the message has the fix.
        OSError: the file cannot be written, or differs from the frames; with the reason.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"a video must be one of {', '.join(SUFFIXES)}, got {str(path)!r}.")
    if not 0 < fps < math.inf:
        raise ValueError(f"fps must be a positive number, got {fps!r}.")
    gif = path.suffix.lower() == ".gif"
    try:
        writer = _Gif(path, fps) if gif else Encoder(path, fps)
    except ImportError as error:
        raise ImportError(NO_WRITER) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    path.open("ab").close()  # whether it can be written, before anything is rendered
    count, shape = 0, None
    try:
        with contextlib.closing(writer):
            for frame in frames:
                shape = _check_frame(frame, shape)
                writer.append(frame)
                count += 1
    finally:
        if path.exists() and path.stat().st_size == 0:
            path.unlink()
    if shape is None:
        raise ValueError(f"{path} was not written: there are no frames.")
    if gif:
        _check_gif(path, count, shape, fps)
    else:
        _check_mp4(path, count, shape)
    return path


class _Gif:
    """Writer of GIF files, with the interface of ``Encoder``."""

    def __init__(self, path: Path, fps: float) -> None:
        from PIL import Image

        self._from_array, self._path, self._milliseconds = Image.fromarray, path, 1000.0 / fps
        self._images: list[Any] = []
        self._times: list[float] = []

    def append(self, frame: np.ndarray) -> None:
        image = self._from_array(frame)
        # Older releases of Pillow lose the time of equal images; newer ones add it up.
        still = bool(self._images) and image == self._images[-1]
        time = self._milliseconds + (self._times[-1] if still else 0.0)
        if time > _LONGEST:
            raise ValueError(
                f"{self._path} is incomplete: a GIF shows an image for at most "
                f"{_LONGEST / 1000:.0f} s, and equal frames last longer; write an .mp4, or raise "
                "fps."
            )
        if still:
            self._times[-1] = time
        else:
            self._images.append(image)
            self._times.append(time)

    def close(self) -> None:
        if not self._images:
            return
        first, *others = self._images
        times = self._times if others else self._times[0]
        moving = {"save_all": True, "duration": times, "loop": 0}
        try:
            first.save(self._path, format="GIF", append_images=others, **moving)
        except BaseException as error:
            self._path.unlink(missing_ok=True)  # a part of a file that nothing shows
            # A side or a time exceeds 16 bits.
            if isinstance(error, (OSError, struct.error)):
                raise OSError(f"{self._path} was not written: {error}.") from error
            raise


def _check_frame(frame: np.ndarray, first: tuple[int, int, int] | None) -> tuple[int, int, int]:
    shape, dtype = np.shape(frame), getattr(frame, "dtype", None)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape or dtype != np.uint8:
        raise ValueError(f"a frame must be (H, W, 3) uint8, got {shape} {dtype}.")
    if first is not None and shape != first:
        raise ValueError(f"all frames must be of one size, got {shape} after {first}.")
    return shape


def _check_mp4(path: Path, count: int, shape: tuple[int, int, int]) -> None:
    expected = (shape[0] + shape[0] % 2, shape[1] + shape[1] % 2, 3)
    decoder = Decoder(path)
    found = [frame.shape for frame in decoder]
    if found != [expected] * count:
        raise OSError(
            f"{path} differs from what was written: {count} frames of {expected}, but it has "
            f"{len(found)} of {found[0] if found else 'no size'}"
            + (f" ({decoder.complaint})." if decoder.complaint else ".")
        )


def _check_gif(path: Path, count: int, shape: tuple[int, int, int], fps: float) -> None:
    from PIL import Image, ImageSequence

    shown = 1000.0 * count / fps
    with Image.open(path) as image:
        size = (image.height, image.width, 3)
        # Consecutive equal frames become one that is shown for longer.
        times = [frame.info.get("duration", 0) for frame in ImageSequence.Iterator(image)]
    # A GIF counts in hundredths of a second.
    if size != shape or abs(sum(times) - shown) > 10 * count:
        raise OSError(
            f"{path} differs from what was written: {shown:.0f} ms of {shape}, but it has "
            f"{sum(times)} ms of {size}."
        )
