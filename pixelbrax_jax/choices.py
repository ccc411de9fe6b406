"""One way each to reject an unknown name, what is not a count, and what is not a share."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from numbers import Integral, Real


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


def check_whole(what: str, value: object) -> int:
    """``value`` if it is a whole number of at least 1.

    Args:
        what: what the value stands for, as the message should call it.
        value: what the user gave; Python's or NumPy's integers, but no truth values.

    Returns:
        ``value`` as Python's own.

    Raises:
        ValueError: otherwise, naming the value.
    """
    if isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1:
        return int(value)
    raise ValueError(f"{what} must be a whole number of at least 1, got {value!r}.")


def check_share(what: str, value: object) -> float:
    """``value`` if it is a number in [0, 1].

    Args:
        what: what the value stands for, as the message should call it.
        value: what the user gave.

    Returns:
        ``value`` as Python's own.

    Raises:
        ValueError: otherwise, naming the value.
    """
    if isinstance(value, Real) and not isinstance(value, bool) and 0.0 <= float(value) <= 1.0:
        return float(value)
    raise ValueError(f"{what} must lie in [0, 1], got {value!r}.")
