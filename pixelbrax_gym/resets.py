"""Check the arguments of ``reset``: seeds, options and masks."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any

import numpy as np

from pixelbrax_jax.validation import check_choice

SEEDS = 2**32
"""Number of seeds; they start at 0."""


def as_seed(seed: Any) -> int:
    """Convert a seed to a Python integer; raise a TypeError if it is not an integer."""
    if not isinstance(seed, (bool, np.bool_)):
        try:
            return operator.index(seed)
        except TypeError:
            pass
    raise TypeError(f"a seed must be an integer, got {seed!r}.")


def check_seed(seed: Any) -> int:
    """Convert a seed to a Python integer; raise a ValueError if it is out of range."""
    seed = as_seed(seed)
    if not 0 <= seed < SEEDS:
        raise ValueError(f"seeds must lie in [0, 2**32), got {seed}.")
    return seed


def seeds_of(seed: Any, num_envs: int) -> list[int | None]:
    """Return a seed for each of N environments: ``seed + i``, entry i of a sequence, or None."""
    if seed is None:
        return [None] * num_envs
    if np.ndim(seed):
        if len(seed) != num_envs:
            raise ValueError(
                f"seed has {len(seed)} entries, but there are {num_envs} environments: give one "
                "seed, or one for each."
            )
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
    """Return ``seed + i`` modulo 2**32 for environment i, for frameworks with seeds of any size."""
    first = as_seed(seed)
    return [(first + i) % SEEDS for i in range(num_envs)]


def read_options(options: Any, seed: Any, num_envs: int | None = None) -> dict[str, Any]:
    """Return ``state`` and ``mask`` in ``options`` of ``reset``; one environment has no mask."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise TypeError(f"options of reset() must be a dict or None, got {options!r}.")
    allowed = ("state",) if num_envs is None else ("reset_mask", "state")
    for name in options:
        check_choice("option of reset()", name, allowed)
    read = {}
    if "reset_mask" in options:
        read["mask"] = as_mask("options['reset_mask']", options["reset_mask"], (num_envs,))
        if not read["mask"].any():
            raise ValueError("options['reset_mask'] must have at least one True.")
    if "state" in options:
        if seed is not None:
            raise ValueError(
                f"reset() takes a seed or options['state'], got both (seed={seed!r}): a state "
                "contains its own random keys; omit one of them."
            )
        if options["state"] is None:
            raise TypeError("options['state'] must be an EnvState of get_state(), got None.")
        read["state"] = options["state"]
    return read


def as_mask(what: str, given: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Convert a bool array or tensor on any device to NumPy, and check its shape."""
    dtype = str(getattr(given, "dtype", "")).removeprefix("torch.")
    if dtype != "bool":
        kind = f"{dtype} array" if dtype else type(given).__name__
        raise TypeError(f"{what} must be an array or tensor of bool, got {kind}.")
    # A copy, because a program may read it after the caller has changed it.
    mask = np.asarray(given.cpu() if hasattr(given, "cpu") else given).copy()
    if mask.shape != shape:
        raise ValueError(f"{what} must have shape {shape}, got {mask.shape}.")
    return mask
