"""Installation of optional dependencies."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata


def install_extra(*names: str) -> str:
    """Return the command that installs one of the given extras, as the end of a message."""
    return " or ".join(f'pip install "pixelbrax[{name}]"' for name in names)


@contextmanager
def needs_extra(extra: str, lacking: str = "") -> Iterator[None]:
    """Add the command that installs an extra to an ImportError; ``lacking`` replaces its text."""
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{lacking or error}; try: {install_extra(extra)}") from error


def lacking(extra: str) -> list[str]:
    """Return the packages of an extra that are not installed, by PixelBrax's own metadata."""
    try:
        required = metadata.requires("pixelbrax") or []
    except metadata.PackageNotFoundError:
        # The sources are used without being installed.
        return []
    found = []
    for line in required:
        package, _, condition = line.partition(";")
        if re.search(rf"extra == ['\"]{extra}['\"]", condition):
            name = re.split(r"[^\w.-]", package, maxsplit=1)[0]
            try:
                metadata.version(name)
            except metadata.PackageNotFoundError:
                found.append(name)
    return found


def check_extra(extra: str, what: str) -> None:
    """Raise an ImportError that names what an extra lacks; ``what`` needs it."""
    if names := lacking(extra):
        verb = "is" if len(names) == 1 else "are"
        raise ImportError(
            f"{what} needs {', '.join(names)}, which {verb} not installed; try: "
            f"{install_extra(extra)}"
        )
