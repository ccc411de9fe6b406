"""One way to reject an unknown name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def check_choice(what: str, value: object, allowed: Iterable[str]) -> str:
    """``value`` if it is one of ``allowed``.

    Args:
        what: what the value stands for, as the message should call it.
        value: what the user gave.
        allowed: every accepted name.

    Returns:
        ``value``.

    Raises:
        ValueError: otherwise, naming the value, all allowed names and the nearest one.
    """
    names = sorted(allowed)
    if isinstance(value, str) and value in names:
        return value
    message = f"unknown {what}: {value!r}; allowed: {', '.join(names)}."
    nearest = difflib.get_close_matches(str(value).lower(), [n.lower() for n in names], n=1)
    if nearest:
        match = next(n for n in names if n.lower() == nearest[0])
        message += f" Did you mean {match!r}?"
    raise ValueError(message)
