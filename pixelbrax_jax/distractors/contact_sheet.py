"""An image of all clips of a bank."""

from __future__ import annotations

from typing import Any

import numpy as np

from pixelbrax_jax.distractors.clips import ClipBank, pillow

_COLUMNS = 6
"""Frames shown of each clip, evenly spaced."""

_GAP = 2


def contact_sheet(bank: ClipBank) -> Any:
    """Return a row for each clip, with a few of its frames.

    Args:
        bank: the clips.

    Returns:
        A Pillow image.

    Raises:
        ImportError: Pillow is missing, with the fix.
    """
    height = bank.frames.shape[1]
    rows = []
    for first, length in zip(bank.first, bank.length, strict=True):
        chosen = first + np.linspace(0, length - 1, _COLUMNS).round().astype(int)
        frames = np.pad(
            bank.frames[chosen], ((0, 0), (0, _GAP), (0, _GAP), (0, 0)), constant_values=255
        )
        rows.append(frames.transpose(1, 0, 2, 3).reshape(height + _GAP, -1, 3))
    return pillow().fromarray(np.concatenate(rows))
