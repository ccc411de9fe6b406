"""Ranges of multipliers of a task's dynamics, as options."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.types import DynamicsRanges
from pixelbrax_jax.validation import check_choice

MULTIPLIERS = tuple(DynamicsRanges.__annotations__)
"""Names of what is multiplied, in the order of a state's multipliers."""

_LARGEST = 1e9
"""Bound of multipliers, far beyond what a simulation survives."""

Ranges = str | Mapping[str, float | tuple[float, float]]


def check_ranges(option: str, value: Any) -> str:
    """Return ranges as text, ``"friction=0.5:2.0,gravity=0.8"``, sorted by name.

    ``value`` is such a text, or a mapping from names to a multiplier or to the lowest and highest.
    """
    return ",".join(
        f"{name}={low!r}" + (f":{high!r}" if high != low else "")
        for name, (low, high) in _parse(option, value).items()
    )


def _parse(option: str, value: Any) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest multiplier by name; raise the errors of ``check_ranges``."""
    if isinstance(value, str):
        parts = [part.partition("=") for part in value.split(",") if part]
        names = [name.strip() for name, _, _ in parts]
        if len(set(names)) < len(names):
            raise ValueError(f"{option} must have each name once, got {value!r}.")
        value = {name: tuple(p[2].split(":")) for name, p in zip(names, parts, strict=True)}
    if not isinstance(value, Mapping):
        raise TypeError(
            f"{option} must be a text such as 'friction=0.5:2,mass=1.2' or a dictionary such as "
            f"{{'friction': (0.5, 2), 'mass': 1.2}}, got {value!r}."
        )
    for name in value:
        check_choice(f"multiplier in {option}", name, MULTIPLIERS)
    return {name: _range(option, name, value[name]) for name in MULTIPLIERS if name in value}


def _range(option: str, name: str, numbers: Any) -> tuple[float, float]:
    try:
        pair = (numbers,) if isinstance(numbers, Real) else tuple(numbers)
        low, high = (float(number) for number in (pair * 2 if len(pair) == 1 else pair))
    except (TypeError, ValueError):
        low = high = math.nan
    if isinstance(numbers, str) or not 0 < low <= high < _LARGEST:
        raise ValueError(
            f"{option} of {name} must be a positive number or two, the lowest first, got "
            f"{numbers!r}."
        )
    return low, high


def as_arrays(value: Ranges) -> DynamicsRanges | None:
    """Return ranges as ``check_ranges`` takes them as arrays; None if nothing varies."""
    found = _parse("dynamics", value)
    if not found:
        return None
    ranges = {name: np.array(found.get(name, (1, 1)), np.float32) for name in MULTIPLIERS}
    return DynamicsRanges(**ranges)  # type: ignore[arg-type]


def sample(ranges: DynamicsRanges, key: jax.Array) -> jax.Array:
    """Return (5,) float32 multipliers, uniform in their ranges."""
    low, high = jnp.stack([getattr(ranges, name) for name in MULTIPLIERS], axis=1)
    return low + (high - low) * jax.random.uniform(key, low.shape)
