"""Checks of names, options and values, with suggestions."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np

_T = TypeVar("_T")

_SIMILAR = 0.65
"""Least similarity, up to 1, of a name that is suggested for an unknown one."""

_SIMILAR_OPTION = 0.75
"""The same for options, whose names share parts such as ``render`` and ``mode``."""

_ELSEWHERE = {
    "batch_size": "num_envs",
    "frame_skip": "action_repeat",
    "frameskip": "action_repeat",
    "max_episode_length": "episode_length",
    "n_envs": "num_envs",
    "num_frames": "frame_stack",
    "num_stack": "frame_stack",
    "time_limit": "episode_length",
}
"""Names of options in other libraries."""

_ADVICE = {
    "channels_first": " Frames have their channels last; in PyTorch obs.permute(0, 3, 1, 2) is a "
    "view with the channels first.",
    "device": " Frames are where JAX computes: on an NVIDIA GPU with the extra cuda12 or cuda13.",
    "num_envs": " Several environments in one program: gymnasium.make_vec, or in JAX "
    "VectorPixelEnv(env, num_envs).",
    **dict.fromkeys(
        ("image_size", "img_size", "resolution", "size"), " Did you mean 'height' and 'width'?"
    ),
}
"""Advice for options that do not exist."""


def check_choice(
    what: str, value: object, allowed: Iterable[str], *, meant: str | None = None
) -> str:
    """Return ``value`` if it is one of ``allowed``; else raise a ValueError with the nearest name.

    ``what`` names the option in the message; ``meant`` replaces the nearest name as suggestion.
    """
    names = sorted(allowed)
    if isinstance(value, str) and value in names:
        return value
    question = f" Did you mean {meant!r}?" if meant in names else suggest(value, names)
    # The nearest name comes first, because there may be dozens of names.
    listed = f".{question} Allowed:" if question else "; allowed:"
    raise ValueError(f"unknown {what}: {value!r}{listed} {', '.join(names)}.")


def check_options(given: Iterable[str], allowed: Iterable[str]) -> None:
    """Raise a TypeError with the nearest name if a keyword argument is unknown.

    Its message starts like Python's own, which some libraries parse to find the known options.
    """
    names = sorted(allowed)
    for name in given:
        if name not in names:
            raise TypeError(
                f"got an unexpected keyword argument {name!r}; allowed: {', '.join(names)}."
                + (_ADVICE.get(name) or suggest(_ELSEWHERE.get(name, name), names, _SIMILAR_OPTION))
            )


def suggest(value: object, names: Iterable[str], likeness: float = _SIMILAR) -> str:
    """Return `` Did you mean 'name'?`` with the most similar name, or an empty string."""
    by_lower = {name.lower(): name for name in names}
    given = str(value).lower()
    nearest = difflib.get_close_matches(given, by_lower, n=1, cutoff=likeness)
    if not nearest and len(given) > 3:
        parts = [name for name in by_lower if given in name]
        nearest = parts if len(parts) == 1 else []
    return f" Did you mean {by_lower[nearest[0]]!r}?" if nearest else ""


def check_bool(what: str, value: object) -> bool:
    """Return a bool of Python or NumPy as a Python bool; raise TypeError for anything else."""
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise TypeError(f"{what} must be True or False, got {value!r}.")


def _check(kind: type, fits: Callable[[Any], bool], wanted: str, what: str, value: Any) -> Any:
    """Return an int or finite float that fits; raise ValueError for anything else."""
    if isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool):
        with suppress(OverflowError):  # an integer beyond all floats
            number = kind(value)
            if abs(number) < math.inf and fits(number):
                return number
    raise ValueError(f"{what} must {wanted}, got {value!r}.")


_Check = Callable[[str, object], _T]
"""``check(what, value)`` returns the value; if it does not fit, a ValueError names ``what``."""

check_positive_int: _Check[int] = partial(_check, int, lambda x: x >= 1, "be a positive integer")
check_count: _Check[int] = partial(_check, int, lambda x: x >= 0, "be a whole number of at least 0")
check_fraction: _Check[float] = partial(_check, float, lambda x: 0 <= x <= 1, "lie in [0, 1]")
check_positive: _Check[float] = partial(_check, float, lambda x: x > 0, "be a positive number")
check_not_negative: _Check[float] = partial(
    _check, float, lambda x: x >= 0, "be a number of at least 0"
)
check_finite: _Check[float] = partial(_check, float, lambda _: True, "be a finite number")
check_link: _Check[int] = partial(
    _check, int, lambda x: x >= -1, "be a whole number of at least -1 (none)"
)


def check_array(what: str, value: Any, *shapes: tuple[int, ...]) -> np.ndarray:
    """Return ``value`` in float32; raise ValueError for another shape, NaN, inf and words."""
    with suppress(ValueError, TypeError):  # such as rows of several lengths
        array = np.asarray(value)
        # No words, objects, dates and complex numbers; JAX's bfloat16 has a kind of its own.
        if array.shape in shapes and array.dtype.kind not in "USOMmc":
            with np.errstate(over="ignore"):
                array = array.astype(np.float32)
            if np.isfinite(array).all():
                return array
    wanted = " or ".join(map(str, shapes))
    raise ValueError(f"{what} must have finite numbers of shape {wanted}, got {value!r}.")


def check_arrays(
    what: str, value: object, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Return attributes by name, checked by ``check_array``; ``what`` is the object's name."""
    return {
        name: check_array(f"{name} of {what}", getattr(value, name), shape)
        for name, shape in shapes.items()
    }
