"""One way each to reject unknown names and options, what is no count, and what is no share."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable
from numbers import Integral, Real
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")


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
    raise ValueError(_unknown(what, value, names))


def check_options(given: Iterable[str], allowed: Iterable[str]) -> None:
    """Keyword arguments are known.

    Args:
        given: their names.
        allowed: every accepted name.

    Raises:
        TypeError: one is not, naming it, all allowed names and the nearest one.
    """
    names = sorted(allowed)
    for name in given:
        if name not in names:
            raise TypeError(_unknown("option", name, names))


def checks_options(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The same function, which tells the nearest name of an option that it does not have.

    Python's own message names neither that nor what there is.

    Args:
        function: one that names all of its options.

    Returns:
        A function of the same signature. It raises ``TypeError`` as Python does.
    """
    allowed = list(inspect.signature(function).parameters)

    @functools.wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        check_options(kwargs, allowed)
        return function(*args, **kwargs)

    return checked


def _unknown(what: str, value: object, names: list[str]) -> str:
    message = f"unknown {what}: {value!r}; allowed: {', '.join(names)}."
    nearest = difflib.get_close_matches(str(value).lower(), [n.lower() for n in names], n=1)
    if nearest:
        match = next(n for n in names if n.lower() == nearest[0])
        message += f" Did you mean {match!r}?"
    return message


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
