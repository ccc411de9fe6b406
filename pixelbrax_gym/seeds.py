"""Seeds of environments, checked and counted on from the first one."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

SEEDS = 2**32
"""Number of seeds there are: 0 to one less than this."""


def as_seed(seed: Any) -> int:
    """Return a seed as Python's own integer.

    Args:
        seed: an integer of Python or NumPy, or an array or tensor of integers without axes.

    Raises:
        TypeError: it is none of these.
    """
    if not isinstance(seed, (bool, np.bool_)):
        try:
            return operator.index(seed)
        except TypeError:
            pass
    raise TypeError(f"a seed must be an integer, got {seed!r}.")


def check_seed(seed: Any) -> int:
    """Return a seed that is in range.

    Raises:
        TypeError: it is no integer.
        ValueError: it is out of range, naming the value.
    """
    seed = as_seed(seed)
    if not 0 <= seed < SEEDS:
        raise ValueError(f"seeds must lie in [0, 2**32), got {seed}.")
    return seed


def seeds_of(seed: Any, num_envs: int) -> list[int | None]:
    """Return a seed for each environment.

    Args:
        seed: s gives environment i the seed s + i; a list, array or tensor has one for each, or
            None. None gives None to all.
        num_envs: N.

    Raises:
        TypeError: a seed is no integer.
        ValueError: a seed is out of range, or there are not N.
    """
    if seed is None:
        return [None] * num_envs
    if np.ndim(seed):
        if len(seed) != num_envs:
            raise ValueError(f"expected one seed for each of {num_envs}, got {len(seed)}.")
        return [None if s is None else check_seed(s) for s in seed]
    first = check_seed(seed)
    if first + num_envs > SEEDS:
        raise ValueError(
            f"seed={first} would give {num_envs} environments the seeds {first} to "
            f"{first + num_envs - 1}, but seeds must lie in [0, 2**32); give at most "
            f"{SEEDS - num_envs}."
        )
    return [first + i for i in range(num_envs)]


def spread_seeds(seed: Any, num_envs: int) -> list[int]:
    """Return ``seed + i`` for environment i, going on at 0 beyond 2**32 - 1.

    For frameworks that hand seeds of any size from one environment to the next.

    Raises:
        TypeError: it is no integer.
    """
    first = as_seed(seed)
    return [(first + i) % SEEDS for i in range(num_envs)]


def check_unseeded(seed: Any) -> None:
    """Reject a seed beside a state, which has its own random numbers.

    Raises:
        ValueError: there is one.
    """
    if seed is not None:
        raise ValueError(
            f"reset() takes a seed or options['state'], got both (seed={seed!r}): a state has the "
            "random numbers of its own episodes; leave one out."
        )
