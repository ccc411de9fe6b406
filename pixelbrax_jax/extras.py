"""Installation of optional dependencies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


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
