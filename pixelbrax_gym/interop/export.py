"""JAX outputs as the arrays that the user asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.validation import check_choice

OUTPUTS = ("jax", "numpy", "torch")


def exporter(output: str) -> Callable[[Any], Any]:
    """Return how to hand out a tree of JAX arrays that nobody reads again.

    ``"numpy"`` gives arrays that may be written to, without a copy where they are on a CPU;
    ``"torch"`` gives tensors on the environment's device, ``"jax"`` the arrays.
    """
    check_choice("output", output, OUTPUTS)
    if output == "torch":
        from pixelbrax_gym.interop.dlpack import to_torch

        return to_torch
    return to_numpy if output == "numpy" else _to_jax


def to_numpy(tree: Any) -> Any:
    """Return every array of a tree as a NumPy array that may be written to.

    Without a copy where the array is on a CPU: hand over only arrays that nobody reads again.
    """
    return jax.tree.map(_writable, tree)


class _Memory:
    """The memory of a read-only array, offered to NumPy as one that may be written to."""

    def __init__(self, array: np.ndarray) -> None:
        # NumPy keeps this object, and so the memory, as long as it has a view of it.
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
