"""Contact sheets: frames of clips, and images with their names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_jax.distractors.clips import ClipBank
from pixelbrax_jax.distractors.media import pillow

_COLUMNS = 6
"""Frames per clip, evenly spaced."""

_GAP = 2

_WIDTH, _TEXT = 1200, 16
"""Greatest width of a sheet of named images, and height of a name, in pixels."""


def check_image(path: str) -> None:
    """Check that an image can be saved under a name, before clips are read."""
    suffix, folder = Path(path).suffix.lower(), Path(path).absolute().parent
    image = pillow()
    if image.registered_extensions().get(suffix) not in image.SAVE:
        raise ValueError(f"a contact sheet must be a .png, .jpg or .webp image, got {path!r}.")
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder} for the contact sheet.")


def contact_sheet(bank: ClipBank) -> Any:
    """Return a Pillow image with a row of frames for each clip."""
    height = bank.frames.shape[1]
    rows = []
    for first, length in zip(bank.first, bank.length, strict=True):
        chosen = first + np.linspace(0, length - 1, _COLUMNS).round().astype(int)
        frames = np.pad(
            bank.frames[chosen], ((0, 0), (0, _GAP), (0, _GAP), (0, 0)), constant_values=255
        )
        rows.append(frames.transpose(1, 0, 2, 3).reshape(height + _GAP, -1, 3))
    return pillow().fromarray(np.concatenate(rows))


def labelled(images: Mapping[str, np.ndarray]) -> Any:
    """Return a Pillow image with images of one size, (H, W, 3) uint8, and their names below."""
    image_module = pillow()
    from PIL import ImageDraw

    height, width = next(iter(images.values())).shape[:2]
    across = min(len(images), max(1, _WIDTH // (width + _GAP)))
    down = -(-len(images) // across)
    size = across * (width + _GAP), down * (height + _TEXT)
    sheet = image_module.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for number, (name, image) in enumerate(images.items()):
        left, top = number % across * (width + _GAP), number // across * (height + _TEXT)
        sheet.paste(image_module.fromarray(image), (left, top))
        draw.text((left + _GAP, top + height + _GAP), name, fill="black")
    return sheet
