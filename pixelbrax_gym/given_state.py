"""States of environments that a caller hands in."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from pixelbrax_jax.types import EnvState


def check_state(state: Any, expected: EnvState) -> None:
    """Reject what is no state of these environments.

    Args:
        state: what the caller gave.
        expected: shapes and dtypes, of ``jax.ShapeDtypeStruct``.

    Raises:
        TypeError: it is no ``EnvState``.
        ValueError: it has other parts, shapes or dtypes; the message names the first.
    """
    if not isinstance(state, EnvState):
        raise TypeError(
            f"a state must be an EnvState, as get_state() returns, got {type(state).__name__}."
        )
    wanted: Any = jax.tree_util.tree_flatten_with_path(expected)
    given: Any = jax.tree.flatten(state)
    if given[1] != wanted[1]:
        raise ValueError(
            f"the state has other parts than those of this environment, {len(given[0])} arrays and "
            f"not {len(wanted[0])}, or others: take it from an environment of the same task, "
            "physics backend, distractors and obs_mode."
        )
    for value, (path, spec) in zip(given[0], wanted[0], strict=True):
        shape, dtype = np.shape(value), getattr(value, "dtype", type(value).__name__)
        if (shape, dtype) != (spec.shape, spec.dtype):
            raise ValueError(
                f"state{jax.tree_util.keystr(path)} must be {spec.dtype} of shape {spec.shape}, "
                f"got {dtype} of shape {shape}."
            )
