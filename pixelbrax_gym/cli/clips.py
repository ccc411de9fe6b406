"""Prepare and list the clips of a video distractor."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import parse


@dataclass(frozen=True)
class Options:
    """Reads, caches and lists the clips of a folder, or generates procedural clips.

    The folder is DAVIS-2017, or contains video files or folders of images.
    """

    source: Annotated[Positional[str], arg(metavar="FOLDER")]
    """Folder of the clips, or 'procedural'."""
    split: str = "train"
    """Split of the clips: train, test or another split of the folder."""
    size: int = 84
    """Height and width of the frames in pixels."""
    num_clips: int | None = None
    """Reads only the first clips, this many; default: all."""
    cache_dir: str | None = None
    """Folder of the cache; default: $PIXELBRAX_CACHE or ~/.cache/pixelbrax."""
    sheet: str | None = None
    """Writes a contact sheet to this image file."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("clips", Options, arguments)
    from pixelbrax_jax.distractors.clips import load_clips
    from pixelbrax_jax.distractors.contact_sheet import check_image, contact_sheet

    if options.sheet:
        check_image(options.sheet)
    bank = load_clips(
        options.source,
        options.split,
        height=options.size,
        width=options.size,
        num_clips=options.num_clips,
        cache_dir=options.cache_dir,
    )
    if options.sheet:
        contact_sheet(bank).save(options.sheet)
    for name, length in zip(bank.names, bank.length, strict=True):
        sys.stdout.write(f"{int(length):6d}  {name}\n")
    sys.stdout.write(
        f"{len(bank.names)} clips, {len(bank.frames)} frames of {options.size} x {options.size} "
        f"pixels, {bank.device_bytes / 1e6:.1f} MB on the device\n"
    )
    if options.sheet:
        sys.stdout.write(f"contact sheet in {options.sheet}\n")
    return 0
