"""JAX arrays as torch tensors and back: the one bridge of all adapters."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from pixelbrax_jax.extras import install_extra

try:
    import torch
    import torch.utils.dlpack
except ImportError as error:
    raise ImportError(f"torch is not installed; try: {install_extra('torch')}") from error


def to_torch(tree: Any) -> Any:
    """Return every array of a tree as a torch tensor on the same device, without a copy.

    A tensor and its array share memory, which torch may write to: hand over only arrays that
    nobody reads again. Waits for a CPU array to be computed; on a GPU, torch's current stream
    waits and the host does not.
    """
    # The arrays themselves, not capsules of them: only so do the two agree on a stream.
    return jax.tree.map(torch.utils.dlpack.from_dlpack, tree)


def actions_to_jax(tensor: torch.Tensor, device: jax.Device) -> np.ndarray | jax.Array:
    """Return a tensor of actions as float32 that a jitted function takes.

    It is copied: JAX computes in the background, and would otherwise read the caller's memory
    after the caller has filled it with the next actions. A CPU tensor becomes a NumPy array.

    Raises:
        TypeError: the tensor is not floating point, or sparse.
        ValueError: the tensor is on another device; the message names both.
    """
    if tensor.layout != torch.strided:
        raise TypeError(f"action must be a dense tensor, got {tensor.layout}; try .to_dense().")
    if not tensor.is_floating_point():
        raise TypeError(f"action must be floating point in [-1, 1], got {tensor.dtype}.")
    expected = torch_device(device)
    if tensor.device.type != expected.type or (
        expected.index is not None and tensor.device.index != expected.index
    ):
        raise ValueError(
            f"the action is on device {tensor.device}, the environment on {device} "
            f"(torch's {expected}); move the action with .to({str(expected)!r})."
        )
    copy = tensor.detach().to(torch.float32, copy=True).contiguous()
    return copy.numpy() if expected.type == "cpu" else jax.dlpack.from_dlpack(copy)


def as_device(device: torch.device | str) -> torch.device:
    """Return a torch device; a ValueError, naming the argument, if it is not there."""
    try:
        place = torch.device(device)
        torch.empty(0, device=place)
    # Torch without CUDA raises an AssertionError.
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"device={device!r} is not there: {reason}.") from error
    return place


def torch_device(device: jax.Device) -> torch.device:
    """Return the torch name of a JAX device; a ValueError if torch has none."""
    if device.platform == "cpu":
        return torch.device("cpu")
    if device.platform in ("gpu", "cuda", "rocm"):
        return torch.device("cuda", device.local_hardware_id)
    raise ValueError(f"torch cannot share the memory of {device}; use output='numpy'.")


def default_torch_device() -> torch.device:
    """Return the torch name of the device on which JAX computes by default."""
    # A small array has it, whatever the device was chosen by.
    (device,) = jax.device_put(np.float32(0)).devices()
    return torch_device(device)
