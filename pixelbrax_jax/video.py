"""Videos and animated images as files."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_jax.extras import install_extra

SUFFIXES = (".gif", ".mp4")
NO_IMAGEIO = f"a video needs imageio; try: {install_extra('video')}"


def write_frames(path: str | Path, frames: Iterable[np.ndarray], fps: int) -> Path:
    """Write frames as they come; what came before an error or Ctrl-C is kept.

    Args:
        path: of the file, ``.mp4``, or ``.gif``, which repeats for ever; folders are made.
        frames: (H, W, 3) uint8 each, all of one size.
        fps: frames per second.

    Returns:
        The path.

    Raises:
        ValueError: the suffix is another.
        ImportError: imageio is not installed, with the fix.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise ValueError(f"a video must be one of {', '.join(SUFFIXES)}, got {str(path)!r}.")
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise ImportError(NO_IMAGEIO) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    moving = {"duration": 1000.0 / fps, "loop": 0}
    options = moving if path.suffix == ".gif" else {"fps": fps, "macro_block_size": 1}
    writer: Any = imageio.get_writer(path, **options)
    with writer, warnings.catch_warnings():
        # Python warns of a fork beside JAX's threads; the child becomes ffmpeg at once.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        for frame in frames:
            writer.append_data(frame)
    return path
