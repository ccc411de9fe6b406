"""A toy task by name, and a suite of one program."""

from __future__ import annotations

import pytest

import pixelbrax_jax
from pixelbrax_jax import registry
from pixelbrax_jax.generalisation import suites
from pixelbrax_jax.generalisation.changes import BodyColor, Rotation
from tests.envs.toy import PARAMS, Ball

TASK = "ball_of_suites"
TINY = {"height": 18, "width": 18, "frame_stack": 2, "episode_length": 5}


@pytest.fixture(autouse=True)
def _task():
    """The ball, for one test."""
    pixelbrax_jax.register(TASK, Ball, camera=PARAMS.rig)
    yield
    registry._OWN_TASKS.pop(TASK)


@pytest.fixture(autouse=True)
def _suite(monkeypatch):
    """The suite ``tiny``: a camera that turns, and a body of another color."""
    levels = (
        suites.CLEAN,
        suites.Level("turned", (Rotation(180.0),)),
        suites.Level("painted", (BodyColor(0.5),)),
    )
    tiny = suites.Suite(lambda _: levels, 3, "tests")
    monkeypatch.setitem(suites.SUITES, "tiny", tiny)
