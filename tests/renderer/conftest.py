"""What the renderer's tests share."""

from __future__ import annotations

import pytest

from tests.renderer.interpreted import interpreted_kernel


@pytest.fixture
def interpreted():
    """``renderer="pallas"`` draws on a CPU."""
    with interpreted_kernel():
        yield
