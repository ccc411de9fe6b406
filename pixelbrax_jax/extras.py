"""Installation of optional dependencies."""

from __future__ import annotations


def install_extra(*names: str) -> str:
    """Return the command that installs one of the given extras, as the end of a message."""
    return " or ".join(f'pip install "pixelbrax[{name}]"' for name in names)
