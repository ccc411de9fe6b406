"""JAX outputs as the arrays that the user asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.choices import check_choice

OUTPUTS = ("jax", "numpy", "torch")


def exporter(output: str) -> Callable[[Any], Any]:
    """How to hand out a tree of JAX arrays.

    Args:
        output: ``"numpy"`` for read-only views, ``"torch"`` for tensors on the environment's
            device, both without a copy where the device is the CPU; ``"jax"`` for the arrays.

    Returns:
        A function of a tree.

    Raises:
        ValueError: another name.
        ImportError: torch is not installed, with the cure.
    """
    check_choice("output", output, OUTPUTS)
    if output == "torch":
        from pixelbrax_gym.dlpack import to_torch

        return to_torch
    return _to_numpy if output == "numpy" else _to_jax


def _to_numpy(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)


def _to_jax(tree: Any) -> Any:
    return tree
