"""Convert JAX arrays to torch tensors and back."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from pixelbrax_jax.extras import needs_extra

with needs_extra("torch", "torch is not installed"):
    import torch
    import torch.utils.dlpack


def to_torch(tree: Any) -> Any:
    """Convert the arrays of a tree to torch tensors on the same device, without a copy.

    Torch may write to the shared memory, so the arrays must not be read again. The call waits for
    arrays on a CPU; on a GPU only torch's current stream waits.
    """
    # DLPack synchronises streams only if it gets the arrays themselves, not their capsules.
    return jax.tree.map(torch.utils.dlpack.from_dlpack, tree)


def actions_to_jax(tensor: torch.Tensor, device: jax.Device) -> np.ndarray | jax.Array:
    """Copy actions to float32, on a CPU by NumPy, so that the caller may overwrite the tensor."""
    if tensor.layout != torch.strided:
        raise TypeError(f"action must be a dense tensor, got {tensor.layout}; try .to_dense().")
    if not tensor.is_floating_point():
        raise TypeError(
            f"action must be floating point in [-1, 1], got {tensor.dtype}; convert it to float32, "
            "e.g. with .float()."
        )
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
    """Return a torch device; raise a ValueError if it is not available."""
    try:
        place = torch.device(device)
        torch.empty(0, device=place)
    # Torch without CUDA raises an AssertionError.
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"device={device!r} is not available: {reason}.") from error
    return place


def torch_device(device: jax.Device) -> torch.device:
    """Return the torch device of a JAX device; raise a ValueError if torch has none."""
    if device.platform == "cpu":
        return torch.device("cpu")
    if device.platform in ("gpu", "cuda", "rocm"):
        return torch.device("cuda", device.local_hardware_id)
    raise ValueError(f"torch cannot share the memory of {device}; use output='numpy'.")


def default_torch_device() -> torch.device:
    """Return the torch device of JAX's default device."""
    # A new array is on the default device, however that was selected.
    (device,) = jax.device_put(np.float32(0)).devices()
    return torch_device(device)
