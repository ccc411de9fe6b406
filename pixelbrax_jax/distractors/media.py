"""Frames of images and videos as people have them, as 8-bit colors at the wanted size."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_jax.distractors.folders import Source
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.ffmpeg import Decoder

AGAIN = "get it again, or remove it"
"""What to do with a file that cannot be read, or lacks something."""


_TOLERANCE = 2
"""Frames that a sound video may have less than its container says."""


class _UnfitError(ValueError):
    """A file that is whole and cannot be taken; the message is the reason and the fix."""


def read_clip(
    source: Source, height: int, width: int, check_count: Callable[[int], None]
) -> tuple[list[np.ndarray], str]:
    """Return the frames of a clip.

    Images are turned as their EXIF orientation says, videos as their display matrix does. 16 bits
    become 8, floats in [0, 1] become 0 to 255, and what is transparent lies on black.

    ``check_count`` is called with the number of frames so far, and may raise.

    Returns:
        (H, W, 3) uint8 each, and what the file lacks, to be said after its name; empty if it lacks
        nothing.

    Raises:
        ValueError: a file cannot be read; the message has the file, the reason and the fix.
        OSError: a file may not be read, or FFmpeg is not found, with the fix.
        MemoryError: a file is too large for this machine's memory, or ``check_count`` says so.
        ImportError: Pillow or imageio-ffmpeg is missing, with the fix.
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
    image_module = pillow()
    try:
        decoder = Decoder(file)
    except ImportError as error:
        raise ImportError(
            f"reading videos needs imageio-ffmpeg; try: {install_extra('clips')}"
        ) from error
    found = 0
    for frame in decoder:
        keep(image_module.fromarray(frame))
        found += 1
    if not found:
        return decoder.complaint or "it has no frames"
    declared = decoder.declared or found
    # Rounded rates add up: 23.98 for 24000 / 1001.
    short = declared - found > _TOLERANCE + declared / 500
    if short and (decoder.complaint or not decoder.of_file):
        why = f" ({decoder.complaint})" if decoder.complaint else ""
        return f"declares {declared} frames and has {found}{why}"
    return ""


def _read_gif(file: Path, keep: Callable[[Any], None]) -> str:
    image_module = pillow()
    found = 0
    try:
        with image_module.open(file) as image:
            while True:
                keep(image)
                found += 1
                image.seek(found)
    except EOFError:
        # It does not declare a number, but marks its end.
        ended = file.read_bytes().rstrip(b"\0").endswith(b";")
        return "" if ended else f"is cut short after {found} frames"
    except MemoryError:
        raise
    except Exception as error:  # Pillow's of damaged files are of every kind
        if not found:
            raise ValueError(f"{file} cannot be read as a video: {_say(file, error)}.") from error
        return f"is cut short after {found} frames"


def _picture(file: Path, height: int, width: int) -> np.ndarray:
    image_module = pillow()
    from PIL import ImageOps

    try:
        with image_module.open(file) as image:
            count = getattr(image, "n_frames", 1)
            # Telephones put a preview beside the image.
            if count > 1 and image.format != "MPO":
                raise _UnfitError(
                    f"it has {count} images, and one is expected; save each in a file of its own"
                )
            return _fit(ImageOps.exif_transpose(image), height, width)
    except MemoryError:
        raise
    except Exception as error:  # Pillow's of damaged files are of every kind
        raise ValueError(f"{file} cannot be read as an image: {_say(file, error)}.") from error


def _say(file: Path, error: Exception) -> str:
    """Return why Pillow cannot read a file, and the fix."""
    image_module = pillow()
    if isinstance(error, _UnfitError):
        return str(error)
    if isinstance(error, image_module.DecompressionBombError):
        limit = f"{2 * image_module.MAX_IMAGE_PIXELS:,} pixels"
        return f"it has more than {limit}; scale it down, or raise PIL.Image.MAX_IMAGE_PIXELS"
    unknown = type(error).__name__ == "UnidentifiedImageError"
    why = _content(file) or ("it is no image" if unknown else str(error).rstrip("."))
    return f"{why}; {AGAIN}"


def _content(file: Path) -> str:
    """Return what is in a file in place of what its name says; empty if that is unknown."""
    with file.open("rb") as opened:
        start = opened.read(256)
    if not start:
        return "it is empty"
    if start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return "it is a web page"
    return ""


def _fit(image: Any, height: int, width: int) -> np.ndarray:
    """Return the middle of an image at the wanted proportions, scaled; (height, width, 3) uint8."""
    image = _to_rgb(image)
    scale = min(image.width / width, image.height / height)
    across, down = max(1, round(scale * width)), max(1, round(scale * height))
    left, top = (image.width - across) // 2, (image.height - down) // 2
    middle = image.crop((left, top, left + across, top + down))
    return np.asarray(middle.resize((width, height), pillow().Resampling.LANCZOS), np.uint8)


def _to_rgb(image: Any) -> Any:
    image_module = pillow()
    # Pillow itself cuts what is above 255.
    if image.mode == "F" or image.mode.startswith("I"):
        values, top = np.asarray(image), 1 if image.mode == "F" else 65535
        if not 0 <= values.min() <= values.max() <= top:
            raise _UnfitError(
                f"its pixels lie in [{values.min()}, {values.max()}] and not in [0, {top}]; save "
                "it with 8 bits"
            )
        if values.dtype.itemsize == 4 and top > 1 and 0 < values.max() <= 255:
            raise _UnfitError(
                f"its pixels of 32 bits lie in [{values.min()}, {values.max()}], which is black "
                "as 16 bits and may be meant as 8; save it with 8 bits"
            )
        image = image_module.fromarray(np.rint(values * (255 / top)).astype(np.uint8))
    if image.has_transparency_data:
        black = image_module.new("RGBA", image.size, (0, 0, 0, 255))
        image = image_module.alpha_composite(black, image.convert("RGBA"))
    return image.convert("RGB")


def pillow() -> Any:
    """Return Pillow's module of images, or raise an ImportError that has the fix."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(f"reading images needs Pillow; try: {install_extra('clips')}") from error
    return Image
