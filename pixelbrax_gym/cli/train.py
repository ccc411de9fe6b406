"""Train an agent."""

from __future__ import annotations

from collections.abc import Sequence

from pixelbrax_gym.cli import needs_extra


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    with needs_extra("train"):
        from pixelbrax_gym.cli._train import train
    return train(list(arguments))
