"""DM Control, where it is installed."""

from __future__ import annotations

import pytest

from tests.physics.dmc import oracle


@pytest.fixture(scope="session")
def dm_control():
    pytest.importorskip("dm_control.suite", exc_type=ImportError)
    try:
        oracle.load("dmc_pendulum_swingup")
    except AttributeError as error:
        pytest.skip(f"this dm_control and this mujoco do not go together: {error}")
