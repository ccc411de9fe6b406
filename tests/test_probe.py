"""What `tests.benchmarks.probe` reads off inputs that have the state, or have nothing of it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.probe import explained, learned

RANDOM = np.random.default_rng(0)


def test_a_linear_function_of_the_inputs_is_explained_and_noise_is_not():
    inputs = RANDOM.normal(size=(200, 4, 3))
    told = inputs @ np.array([1.0, -2.0, 0.5]) + 7.0
    targets = np.stack([told, RANDOM.normal(size=told.shape)], -1)
    assert explained(inputs, targets) == pytest.approx([1.0, 0.0], abs=0.02)


def test_an_encoder_learns_what_its_pictures_show_and_nothing_else():
    # One bright row, whose place is the first entry of the state.
    place = RANDOM.integers(24, size=(64, 4))
    pixels = np.zeros((64, 4, 24, 24, 3), np.uint8)
    pixels[np.arange(64)[:, None], np.arange(4), place] = 255
    targets = np.stack([place.astype(np.float64), RANDOM.normal(size=place.shape)], -1)
    shown, hidden = learned("patch", pixels, targets, updates=60, batch=32)
    assert shown > 0.9
    assert hidden < 0.1
