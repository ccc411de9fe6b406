"""The counter of steps: carries, wraps, and works wherever JAX does."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.core.counter import StepCounter

EDGES = [0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**33 + 5, 2**63, 2**64 - 1]


@pytest.mark.parametrize("value", EDGES)
def test_a_number_comes_back_as_it_was(value):
    assert int(StepCounter.of(value)) == value


@pytest.mark.parametrize("start", EDGES)
@pytest.mark.parametrize("more", [1, 2**31, 2**32 - 1, 2**32, 2**33 + 5, 2**64 - 1])
def test_sums_carry_and_wrap_like_64_bits(start, more):
    expected = (start + more) % 2**64
    assert int(StepCounter.of(start) + more) == expected
    assert int(more + StepCounter.of(start)) == expected
    assert int(StepCounter.of(start) + StepCounter.of(more)) == expected


@pytest.mark.parametrize(
    "more",
    [
        np.int8(7),
        np.int64(7),
        np.uint64(7),
        jnp.uint32(7),
        jnp.array([7], jnp.uint32)[0],
        StepCounter.of(7),
    ],
)
def test_adds_whole_numbers_of_every_kind(more):
    total = StepCounter.of(2**32 - 3) + more
    assert isinstance(total, StepCounter)
    assert int(total) == 2**32 + 4


def test_adds_numpy_numbers_beyond_31_bits():
    assert int(StepCounter.of(2**32 - 1) + np.int64(2**40 + 1)) == 2**40 + 2**32


@pytest.mark.parametrize("value", [-1, -(2**40), 2**64, 2**70])
def test_numbers_out_of_range_are_rejected(value):
    with pytest.raises(ValueError, match=rf"\[0, 2\*\*64\).*{value}"):
        StepCounter.of(value)
    with pytest.raises(ValueError, match=rf"\[0, 2\*\*64\).*{value}"):
        StepCounter.of(0) + value


@pytest.mark.parametrize("value", [True, np.True_, 1.0, np.float32(2), Fraction(1, 2), "3", None])
def test_what_is_no_whole_number_is_rejected(value):
    with pytest.raises(TypeError, match="whole numbers"):
        StepCounter.of(value)
    with pytest.raises(TypeError, match="whole numbers"):
        StepCounter.of(0) + value


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float32, jnp.bool_])
def test_arrays_of_other_dtypes_are_rejected(dtype):
    # A negative int32 would be read as 2^32 less something.
    with pytest.raises(TypeError, match="uint32"):
        StepCounter.of(0) + jnp.ones((), dtype)


def test_inside_a_scan_the_carry_is_kept():
    def count(start: StepCounter, more: jax.Array) -> StepCounter:
        return jax.lax.scan(lambda c, _: (c + more + 1, None), start, length=5)[0]

    counted = jax.jit(count)(StepCounter.of(2**33 - 2), jnp.uint32(2**32 - 1))
    assert int(counted) == 2**33 - 2 + 5 * 2**32


def test_under_vmap_every_counter_is_its_own():
    starts = [2**32 - 1, 5, 2**64 - 1]
    counters = jax.tree.map(lambda *x: jnp.stack(x), *map(StepCounter.of, starts))
    more = jnp.array([1, 2, 3], jnp.uint32)
    summed = jax.vmap(lambda counter, more: counter + more)(counters, more)
    singles = [int(jax.tree.map(lambda x, i=i: x[i], summed)) for i in range(3)]
    assert singles == [2**32, 7, 2]


def test_ten_thousand_million_steps_are_strictly_monotone():
    increment, number = 2**26, 160
    _, counters = jax.lax.scan(lambda c, _: (c + increment,) * 2, StepCounter.of(0), length=number)
    steps = [int(jax.tree.map(lambda x, i=i: x[i], counters)) for i in range(number)]
    assert steps == [increment * (i + 1) for i in range(number)]
    assert steps[-1] > 10**10


def test_as_float_is_within_single_precision():
    for value in (2**24 - 1, 2**32 + 1, 10**10 + 7, 2**64 - 1):
        assert float(StepCounter.of(value).as_float()) == pytest.approx(value, rel=1.2e-7)
