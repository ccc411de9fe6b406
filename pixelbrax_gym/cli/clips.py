"""Prepare the videos of a distractor, and show them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import parse


@dataclass(frozen=True)
class Options:
    """Reads, caches and lists the clips of a folder, or makes procedural ones.

    The folder may be DAVIS-2017, or have video files or folders of images.
    """

    source: Annotated[Positional[str], arg(metavar="FOLDER")]
    """A folder, or 'procedural'."""
    split: str = "train"
    """train, test or another split of the folder."""
    size: int = 84
    """Pixels, square."""
    num_clips: int | None = None
    """Only the first ones."""
    cache_dir: str | None = None
    """Where clips are cached; $PIXELBRAX_CACHE or ~/.cache/pixelbrax by default."""
    sheet: str | None = None
    """Write a contact sheet to this image file."""


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
