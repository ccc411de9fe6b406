"""Paths that users give, and files that are always complete."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def whole_path(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path, with ``~`` expanded; raise the same error as ``in_home``."""
    return in_home(path).absolute()


def in_home(path: str | os.PathLike[str]) -> Path:
    """Expand ``~``; raise FileNotFoundError with the fix if the home folder is unknown."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise FileNotFoundError(
            f"{path} is in a home folder that is unknown; set HOME, or give the whole path."
        ) from error


def make_folder(option: str, path: str | os.PathLike[str]) -> Path:
    """Make a folder that an option names, with its parents, and return it with ``~`` expanded.

    Raises:
        ValueError: a file is in its place, or in that of a parent.
        OSError: it cannot be made, as in a folder that is read-only.
    """
    folder = in_home(path)
    for one in (folder, *folder.parents):
        if (one.exists() or one.is_symlink()) and not one.is_dir():
            what = "a file" if one.exists() else "a link to what does not exist"
            raise ValueError(f"{option} needs the folder {folder}, but {one} is {what}.")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def make_file(option: str, path: str | os.PathLike[str]) -> Path:
    """Make a file that an option names unless it exists, and return it with ``~`` expanded.

    Raises:
        ValueError: a folder is in its place, or a file in that of its folder.
        OSError: it cannot be written.
    """
    file = in_home(path)
    if file.is_dir():
        raise ValueError(f"{option} must be a file, but {file} is a folder.")
    make_folder(option, file.parent)
    # A pipe would wait for its reader.
    if not file.exists() or file.is_file():
        file.open("ab").close()
    return file


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path for a file that then replaces ``path``, so that ``path`` is always complete."""
    # A folder of its own, because several processes may write the file at once.
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        part = Path(folder, path.name)
        yield part
        part.replace(path)
