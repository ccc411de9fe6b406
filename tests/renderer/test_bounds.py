"""Bounds by comparison and choice."""

import jax
import numpy as np
import pytest

from pixelbrax_jax.renderer.intersect import at_least, at_most, between

NAN = np.float32("nan")


@pytest.mark.parametrize(
    ("x", "least", "most", "inside"),
    [(-2.0, 1.0, -2.0, -1.0), (0.5, 1.0, 0.5, 0.5), (1.0, 1.0, 1.0, 1.0), (3.0, 3.0, 1.0, 1.0)],
)
def test_numbers(x, least, most, inside):
    assert at_least(x, 1.0) == least
    assert at_most(x, 1.0) == most
    assert between(-1.0, x, 1.0) == inside


def test_nan_gives_the_bound_and_a_nan_bound_gives_nan():
    assert at_least(NAN, 1.0) == at_most(NAN, 1.0) == 1.0
    assert between(-1.0, NAN, 1.0) == -1.0
    assert np.isnan(at_least(1.0, NAN))
    assert np.isnan(at_most(1.0, NAN))


@pytest.mark.parametrize(("x", "slope"), [(-2.0, 0.0), (-1.0, 0.0), (0.5, 1.0), (1.0, 0.0), (2, 0)])
def test_derivatives_are_those_of_what_is_given(x, slope):
    assert jax.grad(lambda x: between(-1.0, x, 1.0))(float(x)) == slope
