"""How to get what PixelBrax does not install unasked."""

from __future__ import annotations


def install_extra(*names: str) -> str:
    """Return what to do to get an extra, as the end of a message.

    PixelBrax is installed from a clone, and ``-e`` leaves one that is being edited in use. With the
    constraints pip takes the releases that the tests run with.

    Args:
        names: extras of ``pyproject.toml``, any of which will do.

    Returns:
        The command for each, and where to run it.
    """
    commands = " or ".join(f'pip install -c constraints.txt -e ".[{name}]"' for name in names)
    return f"{commands} in your clone of PixelBrax"
