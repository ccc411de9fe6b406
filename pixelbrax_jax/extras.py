"""Installation of optional dependencies."""

from __future__ import annotations

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


def missing_packages(extra: str) -> list[str]:
    """Return the packages of an extra that are not installed, by PixelBrax's own metadata."""
    from packaging.requirements import Requirement

    found = []
    for requirement in map(Requirement, metadata.requires("pixelbrax") or ()):
        marker = requirement.marker
        if marker and marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""}):
            try:
                metadata.version(requirement.name)
            except metadata.PackageNotFoundError:
                found.append(requirement.name)
    return found
