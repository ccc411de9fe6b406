"""Decoding of images and videos to 8-bit colors of one size."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_jax.distractors.folders import Source
from pixelbrax_jax.extras import needs_extra
from pixelbrax_jax.ffmpeg import complaint, declared_frames, decode

AGAIN = "get it again, or remove it"
"""Fix for a file that cannot be read or is incomplete."""


_TOLERANCE = 2
"""Number of declared frames that an intact video may lack."""


class _UnfitError(ValueError):
    """An intact file cannot be used; the message has the reason and the fix."""


def read_clip(
    source: Source, height: int, width: int, check_count: Callable[[int], None]
) -> tuple[list[np.ndarray], str]:
    """Return the frames of a clip, (H, W, 3) uint8 each, and the file's defect, empty if none.

    Images are rotated by their EXIF orientation, videos by their display matrix. 16 bits become 8,
    floats in [0, 1] become 0 to 255, and transparent pixels are blended with black. ``check_count``
    is called with the number of frames so far, and may raise.
    """
    if not source.is_video:
        check_count(len(source.files))
        with ThreadPoolExecutor() as pool:  # Pillow decodes and scales without Python's lock
            return list(pool.map(lambda file: _picture(file, height, width), source.files)), ""
    frames: list[np.ndarray] = []

    def keep(image: Any) -> None:
        frames.append(_fit(image, height, width))
        check_count(len(frames))

    (file,) = source.files
    read = _read_gif if file.suffix.lower() == ".gif" else _read_video
    lack = read(file, keep)
    if not frames:
        raise ValueError(f"{file} cannot be read as a video: {_content(file) or lack}; {AGAIN}.")
    return frames, lack


def _read_video(file: Path, keep: Callable[[Any], None]) -> str:
    from_array = pillow().fromarray
    with needs_extra("clips", "reading videos needs imageio-ffmpeg"):
        found, log = decode(file, lambda frame: keep(from_array(frame)))
    why = complaint(log)
    if not found:
        return why or "it has no frames"
    declared, of_file = declared_frames(file, log)
    # Rounded rates add up: 23.98 for 24000 / 1001.
    short = declared - found > _TOLERANCE + declared / 500
    if short and (why or not of_file):
        return f"declares {declared} frames but has {found}" + (f" ({why})" if why else "")
    return ""


def _read_gif(file: Path, keep: Callable[[Any], None]) -> str:
    image_module = pillow()
    from PIL import ImageSequence

    found = 0
    try:
        with image_module.open(file) as image:
            for frame in ImageSequence.Iterator(image):
                keep(frame)
                found += 1
        # A GIF declares no number of frames, but marks its end.
        ended = file.read_bytes().rstrip(b"\0").endswith(b";")
    except MemoryError:
        raise
    except Exception as error:  # Pillow raises errors of all kinds for damaged files
        if not found:
            raise ValueError(f"{file} cannot be read as a video: {_say(file, error)}.") from error
        ended = False
    return "" if ended else f"is cut short after {found} frames"


def _picture(file: Path, height: int, width: int) -> np.ndarray:
    image_module = pillow()
    from PIL import ImageOps

    try:
        with image_module.open(file) as image:
            count = getattr(image, "n_frames", 1)
            # Phones add a preview to the image.
            if count > 1 and image.format != "MPO":
                raise _UnfitError(
                    f"it has {count} images instead of one; save each in a separate file"
                )
            return _fit(ImageOps.exif_transpose(image), height, width)
    except MemoryError:
        raise
    except Exception as error:  # Pillow raises errors of all kinds for damaged files
        raise ValueError(f"{file} cannot be read as an image: {_say(file, error)}.") from error


def _say(file: Path, error: Exception) -> str:
    image_module = pillow()
    if isinstance(error, _UnfitError):
        return str(error)
    if isinstance(error, image_module.DecompressionBombError):
        limit = f"{2 * image_module.MAX_IMAGE_PIXELS:,} pixels"
        return f"it has more than {limit}; scale it down, or raise PIL.Image.MAX_IMAGE_PIXELS"
    unknown = type(error).__name__ == "UnidentifiedImageError"
    why = _content(file) or ("it is not an image" if unknown else str(error).rstrip("."))
    return f"{why}; {AGAIN}"


def _content(file: Path) -> str:
    """Return what an unreadable file contains instead, or an empty string."""
    with file.open("rb") as opened:
        start = opened.read(256)
    if not start:
        return "it is empty"
    if start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return "it is a web page"
    return ""


def _fit(image: Any, height: int, width: int) -> np.ndarray:
    """Return the center of an image at the requested size, (height, width, 3) uint8."""
    image = _to_rgb(image)
    scale = min(image.width / width, image.height / height)
    across, down = max(1, round(scale * width)), max(1, round(scale * height))
    left, top = (image.width - across) // 2, (image.height - down) // 2
    middle = image.crop((left, top, left + across, top + down))
    return np.asarray(middle.resize((width, height), pillow().Resampling.LANCZOS), np.uint8)


def _to_rgb(image: Any) -> Any:
    image_module = pillow()
    # Pillow would clip values above 255.
    if image.mode == "F" or image.mode.startswith("I"):
        values, top = np.asarray(image), 1 if image.mode == "F" else 65535
        if not 0 <= values.min() <= values.max() <= top:
            raise _UnfitError(
                f"its pixels are in [{values.min()}, {values.max()}], not in [0, {top}]; save "
                "it with 8 bits"
            )
        if values.dtype.itemsize == 4 and top > 1 and 0 < values.max() <= 255:
            raise _UnfitError(
                f"its 32-bit pixels are in [{values.min()}, {values.max()}], which is black in 16 "
                "bits but may mean 8 bits; save it with 8 bits"
            )
        image = image_module.fromarray(np.rint(values * (255 / top)).astype(np.uint8))
    if image.has_transparency_data:
        black = image_module.new("RGBA", image.size, (0, 0, 0, 255))
        image = image_module.alpha_composite(black, image.convert("RGBA"))
    return image.convert("RGB")


def pillow() -> Any:
    """Return Pillow's module ``Image``, or raise an ImportError with the fix."""
    with needs_extra("clips", "reading images needs Pillow"):
        from PIL import Image
    return Image
