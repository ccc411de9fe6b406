"""How long videos take from the disk to the device."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from pixelbrax_jax import load_clips

CLIPS, FRAMES, HEIGHT, WIDTH = 60, 70, 480, 854
"""As many images as DAVIS-2017's training split has at most, and as large."""


def load(size: int, frames: int = FRAMES) -> dict[str, Any]:
    """Seconds from a folder in DAVIS's layout: read, read from the cache, moved to the device.

    The images have just been written, so that they come from memory and not from a disk.

    Args:
        size: pixels of an observation's side.
        frames: of each clip.
    """
    with tempfile.TemporaryDirectory() as folder:
        davis = Path(folder) / "DAVIS"
        _write(davis, frames)
        options = {"split": "train", "height": size, "width": size, "progress": False}
        seconds = {}
        for name in ("read", "read from the cache"):
            started = time.perf_counter()
            bank = load_clips(davis, cache_dir=Path(folder) / "cache", **options)
            seconds[name] = time.perf_counter() - started
        jax.devices()  # starting JAX is not what is to be timed
        started = time.perf_counter()
        jax.block_until_ready(bank.to_device().packed)
        seconds["move to the device"] = time.perf_counter() - started
        file_bytes = sum(file.stat().st_size for file in davis.rglob("*.jpg"))
    return {
        "clips": CLIPS,
        "frames": CLIPS * frames,
        "file_bytes": file_bytes,
        "bank_bytes": bank.device_bytes,
        "seconds": seconds,
    }


def _write(davis: Path, frames: int) -> None:
    """Rolling images, smooth with some noise as a camera's."""
    draw = np.random.default_rng(0)
    names = [f"clip{number:02}" for number in range(CLIPS)]
    for name in names:
        coarse = draw.integers(0, 256, (24, 43, 3), dtype=np.uint8)
        smooth = np.asarray(
            Image.fromarray(coarse).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
        )
        image = np.clip(smooth + draw.normal(0.0, 8.0, smooth.shape), 0, 255).astype(np.uint8)
        images = davis / "JPEGImages" / "480p" / name
        images.mkdir(parents=True)
        for frame in range(frames):
            Image.fromarray(np.roll(image, 4 * frame, 1)).save(images / f"{frame:05}.jpg")
    lists = davis / "ImageSets" / "2017"
    lists.mkdir(parents=True)
    (lists / "train.txt").write_text("\n".join(names) + "\n")
