"""Programs computed with the batch as last axis are those of ``jax.vmap``."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType
from jax.sharding import PartitionSpec as P

from pixelbrax_jax._platform import interpreter as module
from pixelbrax_jax._platform.interpreter import batch_last
from tests.platform.equations import equations
from tests.platform.functions import FUNCTIONS, TABLE, doubled, nested


@pytest.mark.parametrize(
    "size",
    [1, pytest.param(3, marks=pytest.mark.slow), 5, pytest.param(16, marks=pytest.mark.slow)],
)
def test_results_are_those_of_vmap(size):
    x = jax.random.normal(jax.random.key(size), (size, 3))

    @jax.jit
    def both(x):
        return {n: (jax.vmap(fn)(x), batch_last(fn, (0,))(x)) for n, fn in FUNCTIONS.items()}

    for name, (expected, actual) in both(x).items():
        for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
            assert (a.shape, a.dtype) == (b.shape, b.dtype), name
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6, err_msg=name)


def test_arguments_may_be_trees_keys_and_the_same_for_all():
    def fn(row, shift):
        key, extra = row["key"], row["none"]
        assert extra is None
        return {"key": jax.random.split(key)[0], "sum": row["x"] + shift["y"]}

    row = {
        "key": jax.random.split(jax.random.key(1), 6),
        "none": None,
        "x": jnp.arange(6.0),
    }
    shift = {"y": jnp.float32(2)}
    actual = batch_last(fn, (0, None))(row, shift)
    expected = jax.vmap(fn, in_axes=(0, None))(row, shift)
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    assert jnp.array_equal(actual["key"], expected["key"])
    np.testing.assert_array_equal(actual["sum"], expected["sum"])


def test_numbers_of_rows_must_agree():
    fn = batch_last(lambda x, y: x + y, (0, 0))
    with pytest.raises(ValueError, match=r"same number of rows, got \[2, 3\]"):
        fn(jnp.ones(3), jnp.ones(2))
    assert batch_last(lambda _, y: y + 1, (0, 0))(None, jnp.ones(0)).shape == (0,)


def test_a_shard_map_that_tracks_what_varies():
    mesh = jax.make_mesh((1,), ("i",), axis_types=(AxisType.Auto,))
    double = batch_last(lambda x: x * 2.0, (0,))
    sharded = jax.shard_map(double, mesh=mesh, in_specs=P("i"), out_specs=P("i"))
    np.testing.assert_array_equal(jax.jit(sharded)(jnp.ones(5)), jnp.full(5, 2.0))


def test_equations_keep_their_contexts():
    def draw(x):
        with jax.threefry_partitionable(False):
            return jax.random.normal(jax.random.key(0), (4,)) + x

    actual = batch_last(draw, (0,))(jnp.zeros(2))
    np.testing.assert_array_equal(actual, jax.vmap(draw)(jnp.zeros(2)))


@pytest.mark.parametrize("function", ["split_scan", "bind", "_reshape_wrongly"])
def test_what_is_not_known_is_computed_by_vmap(monkeypatch, function):
    """As if a release of JAX had other parameters, or shapes that no rule foresaw."""
    if function == "_reshape_wrongly":
        monkeypatch.setitem(module.RULES, "reshape", lambda eqn, inputs, size: [inputs[0].value])
    else:
        monkeypatch.setattr(module, function, lambda *_: {}["num_carry"])

    def fn(x):
        return nested(x)[1].reshape(-1), jax.jit(jnp.sin)(x)

    x = jax.random.normal(jax.random.key(0), (5, 3))
    with pytest.warns(RuntimeWarning, match=r"jax .* has programs .* computed by jax\.vmap"):
        actual = jax.jit(batch_last(fn, (0,)))(x)
    for a, b in zip(actual, jax.jit(jax.vmap(fn))(x), strict=True):
        np.testing.assert_array_equal(a, b)


def test_mistakes_of_the_function_itself_are_not_hidden():
    with pytest.raises(ZeroDivisionError):
        batch_last(lambda x: x * (1 // 0), (0,))(jnp.ones(5))


@pytest.mark.parametrize("size", [4, 5])
def test_derivatives_are_those_of_vmap(size):
    def loss(form, x):
        return jnp.sum(form(lambda y: doubled(y) @ jnp.stack([y, TABLE[1], y * y]))(x))

    x = jnp.linspace(-1, 1, 3 * size).reshape(size, 3)
    actual = jax.grad(lambda x: loss(lambda fn: batch_last(fn, (0,)), x))(x)
    np.testing.assert_allclose(actual, jax.grad(lambda x: loss(jax.vmap, x))(x), rtol=1e-5)


@pytest.mark.parametrize("join", [jnp.stack, jnp.concatenate])
def test_joined_arrays_are_behind_a_barrier(join):
    jaxpr = jax.make_jaxpr(batch_last(lambda x: join([x, jnp.sin(x)]), (0,)))(jnp.ones((5, 3)))
    held = {id(eqn.invars[0]) for eqn in equations(jaxpr.jaxpr) if "barrier" in eqn.primitive.name}
    names = ("concatenate", "stack")
    joined = [eqn for eqn in equations(jaxpr.jaxpr) if eqn.primitive.name in names]
    assert joined
    assert {id(eqn.outvars[0]) for eqn in joined} == held


@pytest.mark.parametrize("size", [4, 5])
def test_products_of_few_rows_are_sums_over_an_axis(size):
    jaxpr = jax.make_jaxpr(batch_last(jnp.dot, (0, 0)))(jnp.ones((size, 3)), jnp.ones((size, 3)))
    names = [eqn.primitive.name for eqn in equations(jaxpr.jaxpr)]
    assert "dot_general" not in names
    assert ("reduce_sum" in names) == (size == 4)
