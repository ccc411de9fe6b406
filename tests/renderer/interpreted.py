"""The kernel for NVIDIA GPUs on any device: computed by XLA, slowly."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from pixelbrax_jax.renderer import choice, kernel


@contextmanager
def interpreted_kernel() -> Iterator[None]:
    """Have ``renderer="pallas"`` draw on any device."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "INTERPRET", True)
        patch.setattr(choice, "why_not_here", lambda: None)
        yield
