"""The folder in which PixelBrax keeps what it need not make twice."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(given: str | Path | None = None) -> Path:
    """Return the given folder, else ``$PIXELBRAX_CACHE``, else ``~/.cache/pixelbrax``.

    Raises:
        FileNotFoundError: the user has no home folder, and it would be in it; with the fix.
    """
    named = given or os.environ.get("PIXELBRAX_CACHE")
    if named:
        return in_home(Path(named))
    try:
        return Path.home() / ".cache" / "pixelbrax"
    except RuntimeError as error:  # as of a container's user that has no entry anywhere
        raise FileNotFoundError(
            "the user has no home folder; set HOME, or PIXELBRAX_CACHE to a folder"
        ) from error


def whole_path(path: str | os.PathLike[str]) -> Path:
    """Return a path from the root, with the home folder in place of ``~``.

    Raises:
        FileNotFoundError: there is no such home folder; with the fix.
    """
    return in_home(Path(path)).absolute()


def in_home(path: Path) -> Path:
    """Return a path with the home folder in place of ``~``, or raise as ``whole_path`` does."""
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise FileNotFoundError(
            f"{path} is in a home folder that is unknown; set HOME, or give the whole path."
        ) from error
