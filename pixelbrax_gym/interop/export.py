"""Convert JAX outputs to the type of array that the user selected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.validation import check_choice

OUTPUTS = ("jax", "numpy", "torch")


def exporter(output: str) -> Callable[[Any], Any]:
    """Return a function that converts trees of JAX arrays, which must not be read again."""
    check_choice("output", output, OUTPUTS)
    if output == "torch":
        from pixelbrax_gym.interop.dlpack import to_torch

        return to_torch
    return to_numpy if output == "numpy" else _to_jax


def to_numpy(tree: Any) -> Any:
    """Convert arrays that are not read again to writable NumPy arrays, without a copy on a CPU."""
    return jax.tree.map(_writable, tree)


class _Memory:
    """The memory of a read-only array, offered to NumPy as writable."""

    def __init__(self, array: np.ndarray) -> None:
        # NumPy keeps this object, and thus the memory, while a view exists.
        self._array = array
        self.__array_interface__ = {
            **array.__array_interface__,
            "data": (array.ctypes.data, False),
        }


def _writable(array: jax.Array) -> np.ndarray:
    (device,) = array.devices()
    if device.platform != "cpu" or not array.size:
        return np.array(jax.device_get(array))
    # The interface has no name for types such as bfloat16.
    return np.asarray(_Memory(np.asarray(array))).view(array.dtype)


def _to_jax(tree: Any) -> Any:
    return tree
