"""How to get what PixelBrax does not install unasked."""

from __future__ import annotations


def install_extra(*names: str) -> str:
    """Return the command that installs an extra, as the end of a message.

    Args:
        names: extras of ``pyproject.toml``, any of which will do.
    """
    return " or ".join(f'pip install "pixelbrax[{name}]"' for name in names)
