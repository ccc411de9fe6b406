"""Colors, cameras and lights are those that were last accepted; `make golden` accepts new ones."""

from __future__ import annotations

import numpy as np
import pytest

from tests.golden.images import LOOKS, TASKS, draw, kept, suite_of

ROUNDING = 2
"""Of 255: a color computed in another order of operations is rounded to a neighbor."""
EDGES = 0.002
"""Fraction of pixels that may differ by more: their rays graze an edge, which the last bits of a
pose or of an intersection decide."""


def fraction_changed(one: np.ndarray, other: np.ndarray) -> float:
    """Return the fraction of pixels that differ by more than rounding."""
    difference = np.abs(one.astype(int) - other.astype(int)).max(axis=-1)
    return float((difference > ROUNDING).mean())


QUICK = {"brax": "default", "dmc": "dmc"}
"""Looks that `make test` draws, by suite."""

CASES = [
    pytest.param(task, look, marks=() if QUICK.get(suite_of(task)) == look else pytest.mark.slow)
    for task in TASKS
    for look in LOOKS[suite_of(task)]
]


@pytest.mark.parametrize(("task", "look"), CASES)
def test_images_are_those_that_were_accepted(task, look):
    image, golden = draw(task, look), kept(task, look)
    assert image.shape == golden.shape
    assert fraction_changed(image, golden) <= EDGES


def test_a_small_change_is_seen():
    golden = kept("reacher")
    assert fraction_changed(golden, golden) == 0
    moved = np.roll(golden, 1, axis=1)
    darker = (golden * 0.98).astype(np.uint8)
    assert fraction_changed(golden, moved) > 5 * EDGES
    assert fraction_changed(golden, darker) > 5 * EDGES
