"""What the tests of an accelerator run under.

Without a GPU that both JAX and PyTorch see they are skipped; `make test-gpu` sets
``PIXELBRAX_TESTS_DEVICE=cuda``, so that they fail instead. With ``cpu`` those that need no CUDA run
on the CPU, which shows that they are written right.
"""

from __future__ import annotations

import os

import jax
import pytest
import torch

WANTED = os.environ.get("PIXELBRAX_TESTS_DEVICE", "")


@pytest.fixture(autouse=True)
def device(request) -> str:
    """The device of the test as torch names it: ``cuda``, or ``cpu`` where that is asked for."""
    missing = [
        name
        for name, has in (
            ("JAX", jax.devices()[0].platform == "gpu"),
            ("torch", torch.cuda.is_available()),
        )
        if not has
    ]
    if not missing:
        return "cuda"
    why = f"needs an NVIDIA GPU, which is not seen by {' or '.join(missing)}"
    if WANTED == "cuda":
        pytest.fail(why)
    if WANTED != "cpu":
        pytest.skip(f"{why}; make test-gpu runs it where there is one")
    if request.node.get_closest_marker("cuda_only"):
        pytest.skip("a CPU has no streams and no memory of its own")
    return "cpu"
