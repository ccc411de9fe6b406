"""The argument ``options`` of ``reset``: what there is, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pixelbrax_jax.validation import check_choice


def check_reset_options(options: Any, allowed: tuple[str, ...] = ()) -> None:
    """Reject options that nothing would read.

    Args:
        options: what the caller gave, None or a dict.
        allowed: names of options that there are.

    Raises:
        TypeError: it is neither None nor a dict.
        ValueError: an option is unknown; the message names it and what there is.
    """
    if options is None:
        return
    if not isinstance(options, Mapping):
        raise TypeError(f"options of reset() must be a dict or None, got {options!r}.")
    if options and not allowed:
        raise ValueError(
            f"reset() takes no options, got {', '.join(map(repr, options))}; a seed is given as "
            "reset(seed=...), everything else when the environment is made."
        )
    for name in options:
        check_choice("option of reset()", name, allowed)


def reset_mask(options: Mapping[str, Any] | None, num_envs: int) -> np.ndarray | None:
    """Return which environments ``options["reset_mask"]`` resets.

    Args:
        options: what the caller gave, checked.
        num_envs: N.

    Returns:
        (N,) bool; None if there is no mask.

    Raises:
        TypeError: the mask is no array or tensor of bool.
        ValueError: it has another shape, or no True.
    """
    if not options or "reset_mask" not in options:
        return None
    mask = as_mask("options['reset_mask']", options["reset_mask"], (num_envs,))
    if not mask.any():
        raise ValueError("options['reset_mask'] must have at least one True.")
    return mask


def as_mask(what: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a mask in the host's memory.

    Args:
        what: what the mask stands for, as the message should call it.
        given: a NumPy array, torch tensor or JAX array, on any device.
        shape: that it must have.

    Raises:
        TypeError: it is no array or tensor of bool.
        ValueError: it has another shape.
    """
    dtype = str(getattr(given, "dtype", "")).removeprefix("torch.")
    if dtype != "bool":
        kind = f"{dtype} array" if dtype else type(given).__name__
        raise TypeError(f"{what} must be an array or tensor of bool, got {kind}.")
    mask = np.asarray(given.cpu() if hasattr(given, "cpu") else given)
    if mask.shape != shape:
        raise ValueError(f"{what} must have shape {shape}, got {mask.shape}.")
    return mask
