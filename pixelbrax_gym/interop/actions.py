"""Convert a caller's actions to arguments of a jitted function."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_MANY = 8
"""Maximum number of environments named in a message."""


def as_actions(action: Any, shape: tuple[int, ...], device: jax.Device) -> Any:
    """Check actions and convert them to float32 of ``shape``, (A,) or (N, A).

    ``action`` is a NumPy or JAX array, a torch tensor, or anything NumPy converts. The result
    shares no memory that the caller can write to. JAX arrays and GPU tensors are not searched for
    NaN, which would wait for the device; it ends the episode with ``info["non_finite"]``.
    """
    is_torch = type(action).__module__.partition(".")[0] == "torch"
    if not is_torch and not isinstance(action, jax.Array):
        try:
            action = np.asarray(action)
        except ValueError as error:
            raise ValueError(
                f"action must be an array of shape {shape}, got rows of different lengths."
            ) from error
    if tuple(action.shape) != shape:
        raise ValueError(f"action must have shape {shape}, got {tuple(action.shape)}.")
    if is_torch:
        from pixelbrax_gym.interop import dlpack

        values = dlpack.actions_to_jax(action, device)
    elif not jnp.issubdtype(action.dtype, jnp.floating):
        raise TypeError(
            f"action must be floating point in [-1, 1], got {action.dtype}; convert it to float32, "
            "e.g. with .astype('float32')."
        )
    elif isinstance(action, jax.Array):
        if action.devices() != {device}:
            names = ", ".join(sorted(str(place) for place in action.devices()))
            raise ValueError(
                f"the action is on {names}, the environment on {device}; move the action with "
                "jax.device_put."
            )
        return action if action.dtype == np.float32 else action.astype(np.float32)
    else:
        # A copy: JAX may read it after the caller has begun to fill in the next action.
        with np.errstate(over="ignore"):  # infinity is clipped like all beyond the limits
            values = np.array(action, np.float32)
    if isinstance(values, np.ndarray):
        _check_nan(values)
    return values


def _check_nan(values: np.ndarray) -> None:
    bad = np.isnan(values)
    if not bad.any():
        return
    if values.ndim == 1:
        raise ValueError("the action contains NaN; nothing was stepped.")
    broken = bad.any(axis=1)
    one = "the action of environment" if broken.sum() == 1 else "the actions of environments"
    verb = "contains" if broken.sum() == 1 else "contain"
    raise ValueError(f"{one} {name_rows(broken)} {verb} NaN; nothing was stepped.")


def name_rows(mask: np.ndarray) -> str:
    """List the environments of an (N,) bool mask for a message; omit all after the first few."""
    rows = np.flatnonzero(mask)
    return ", ".join(str(row) for row in rows[:_MANY]) + (", ..." if len(rows) > _MANY else "")
