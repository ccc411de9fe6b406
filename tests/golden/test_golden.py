"""Colors, cameras and lights are those that were last accepted; `make golden` accepts new ones."""

from __future__ import annotations

import numpy as np
import pytest

from pixelbrax_jax.tasks import GYM_TASKS
from tests.golden.images import TASKS, draw, kept

ROUNDING = 2
"""Of 255: a color computed in another order of operations is rounded to a neighbor."""
EDGES = 0.002
"""Fraction of pixels that may differ by more: their rays graze an edge, which the last bits of a
pose or of an intersection decide."""


def fraction_changed(one: np.ndarray, other: np.ndarray) -> float:
    """Return the fraction of pixels that differ by more than rounding."""
    difference = np.abs(one.astype(int) - other.astype(int)).max(axis=-1)
    return float((difference > ROUNDING).mean())


@pytest.mark.parametrize(
    "task", [pytest.param(t, marks=pytest.mark.slow if t in GYM_TASKS else ()) for t in TASKS]
)
def test_images_are_those_that_were_accepted(task):
    image, golden = draw(task), kept(task)
    assert image.shape == golden.shape
    assert fraction_changed(image, golden) <= EDGES


def test_a_small_change_is_seen():
    golden = kept("reacher")
    assert fraction_changed(golden, golden) == 0
    moved = np.roll(golden, 1, axis=1)
    darker = (golden * 0.98).astype(np.uint8)
    assert fraction_changed(golden, moved) > 5 * EDGES
    assert fraction_changed(golden, darker) > 5 * EDGES
