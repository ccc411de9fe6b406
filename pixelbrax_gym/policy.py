"""Call a trained JAX policy with torch tensors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import jax

from pixelbrax_gym.interop.dlpack import to_torch
from pixelbrax_jax.policy import load_policy

if TYPE_CHECKING:
    import torch


class TorchPolicy:
    """The policy of a ``policy.jax``, called with tensors on any device, without a copy.

    It compiles once for each number of observations, and has no gradient.

    Examples:
        ``action = TorchPolicy("runs/ppo/policy.jax")(obs)``
    """

    def __init__(self, path: str | Path) -> None:
        """Load the file that ``pixelbrax train`` wrote.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not a policy.
            ImportError: a package that reads the file is not installed.
        """
        self._act = load_policy(path)

    def __call__(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return mean actions, (B, A) float32, of pixels, (B, H, W, 3K) uint8, oldest frame first.

        Raises:
            ValueError: the dtype or shape differs from training.
        """
        action: torch.Tensor = to_torch(self._act(jax.dlpack.from_dlpack(pixels.contiguous())))
        return action
