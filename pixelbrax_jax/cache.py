"""The cache folder, and paths in the home folder."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(given: str | Path | None = None) -> Path:
    """Return the given folder, else ``$PIXELBRAX_CACHE``, else ``~/.cache/pixelbrax``.

    Raises:
        FileNotFoundError: the home folder is needed but unknown; the message has the fix.
    """
    named = given or os.environ.get("PIXELBRAX_CACHE")
    if named:
        return in_home(Path(named))
    try:
        return Path.home() / ".cache" / "pixelbrax"
    except RuntimeError as error:  # such as a container's user without an entry in passwd
        raise FileNotFoundError(
            "the user has no home folder; set HOME, or PIXELBRAX_CACHE to a folder"
        ) from error


def whole_path(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path, with ``~`` expanded.

    Raises:
        FileNotFoundError: the home folder is unknown; the message has the fix.
    """
    return in_home(Path(path)).absolute()


def in_home(path: Path) -> Path:
    """Expand ``~``; raise the same error as ``whole_path``."""
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise FileNotFoundError(
            f"{path} is in a home folder that is unknown; set HOME, or give the whole path."
        ) from error
