"""A trained JAX policy that takes and gives torch tensors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import jax

from pixelbrax_gym.interop.dlpack import (
    to_torch,
)  # Where torch is missing, its message has the fix.
from pixelbrax_jax.policy import load_policy

if TYPE_CHECKING:
    import torch


class TorchPolicy:
    """The policy of a ``policy.jax``, called with tensors.

    Tensors cross by DLPack, without a copy, on whatever device they are. The policy is compiled
    once for each number of observations. It has no gradient.

    Example:
        ``action = TorchPolicy("runs/ppo/policy.jax")(obs)``
    """

    def __init__(self, path: str | Path) -> None:
        """Load the file that ``pixelbrax train`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no policy.
            ImportError: what reads it is not installed, with the fix.
        """
        self._act = load_policy(path)

    def __call__(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return the mean actions of observations.

        Args:
            pixels: (B, H, W, 3 K) uint8, oldest frame first, as environments give them.

        Returns:
            (B, A) float32 on the same device.

        Raises:
            ValueError: another dtype or shape than that of training.
        """
        action: torch.Tensor = to_torch(self._act(jax.dlpack.from_dlpack(pixels.contiguous())))
        return action
