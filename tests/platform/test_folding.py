"""Folded programs compute the same, and index by constants with slices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core
from jax.sharding import AxisType
from jax.sharding import PartitionSpec as P

from pixelbrax_jax._platform import folding
from pixelbrax_jax._platform.by_platform import by_platform
from pixelbrax_jax._platform.folding import fold
from tests.platform.functions import FUNCTIONS, TABLE

X = jnp.array([0.3, -1.2, 0.7])
MATRIX = jnp.arange(12.0).reshape(3, 4)
FEW, MANY = np.array([2, 0, 0]), np.arange(65) % 3


def names_of(function, *args):
    """The primitives of a program, also of those that contain one, such as a scatter."""

    def every(jaxpr):
        for eqn in jaxpr.eqns:
            yield eqn.primitive.name
            for sub in core.jaxprs_in_params(eqn.params):
                yield from every(sub)

    return set(every(jax.make_jaxpr(function)(*args).jaxpr))


def same(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6)


def test_results_are_the_same():
    def each(form):
        return jax.jit(lambda x: {name: form(fn)(x) for name, fn in FUNCTIONS.items()})

    folded, expected = each(fold)(X), each(lambda fn: fn)(X)
    for name in FUNCTIONS:
        same(folded[name], expected[name])


INDEXING = {
    "rows": lambda x: x[FEW],
    "columns": lambda x: x[:, FEW],
    "from the end": lambda x: x[jnp.array([-1, 0])],
    "a table of rows": lambda x: x[jnp.array([[0, 1], [2, 2]])],
    "take": lambda x: jnp.take(x, FEW, axis=1, mode="clip"),
    "set rows": lambda x: x.at[FEW[:2]].set(MATRIX[:2]),
    "set columns": lambda x: x.at[:, jnp.array([1, 3])].set(7.0),
    "add to rows": lambda x: x.at[FEW].add(x[:3]),
    "add to columns": lambda x: x.at[:, FEW].add(MATRIX[:, 1:]),
    "insert": lambda x: jnp.insert(x, 1, 5.0, axis=0),
    "sums of segments": lambda x: jax.ops.segment_sum(x, FEW, 3),
    "in a loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y[FEW] + 1, x),
    "in a call": lambda x: jax.jit(lambda y: y[FEW])(x),
    "of many": jax.vmap(lambda row: row[FEW] + row.at[FEW].add(1.0)[:3]),
}


@pytest.mark.parametrize("name", INDEXING)
def test_constant_indices_become_slices(name):
    function = INDEXING[name]
    assert names_of(function, MATRIX) & {"gather", "scatter", "scatter-add"}
    assert not names_of(fold(function), MATRIX) & {"gather", "scatter", "scatter-add"}
    same(jax.jit(fold(function))(MATRIX), function(MATRIX))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x[MANY],
        lambda x: x.at[MANY].add(1.0),
        lambda x: x.at[jnp.array([1, 7])].get(mode="fill", fill_value=3.0),
        lambda x: x.at[jnp.array([1, 7])].set(5.0, mode="drop"),
        lambda x: x[jnp.array([0, 2]), jnp.array([1, 3])],
        lambda x: x[jnp.argmax(x, axis=1)],
        lambda x: jnp.take_along_axis(x, jnp.argsort(x, axis=1), axis=1),
    ],
    ids=["many", "add to many", "beyond", "set beyond", "two axes", "its own", "one in each row"],
)
def test_other_indices_stay_as_they_are(function):
    names = names_of(fold(function), MATRIX)
    assert names & {"gather", "scatter", "scatter-add"}
    same(jax.jit(fold(function))(MATRIX), function(MATRIX))


def loop_of(constant, index=0):
    """A loop of a loop, with known constants and a known index."""

    def turn(i, x):
        return jax.lax.fori_loop(0, 2, lambda j, y: y[index] + jnp.cos(constant) * y, x)

    return lambda x: jax.lax.fori_loop(0, 3, turn, x)


@pytest.mark.parametrize(
    ("function", "names"),
    [
        (lambda x: x + jnp.sin(TABLE).sum() * jnp.arange(3), {"add"}),
        (lambda x: x + jax.jit(jnp.sin)(TABLE[0]), {"add"}),
        (lambda x: loop_of(jnp.sin(TABLE[0]))(x), None),
        (lambda x: loop_of(jnp.sin(TABLE[0]), jnp.argsort(-TABLE[0]))(x), None),
    ],
    ids=["outside", "in a call", "for loops", "indices of loops"],
)
def test_what_is_known_is_not_in_the_program(function, names):
    found = names_of(fold(function), X)
    assert not found & {"sin", "cos", "sort", "gather"}
    assert names is None or found == names
    same(jax.jit(fold(function))(X), function(X))


def of_platform():
    return jax.lax.platform_dependent(cpu=lambda: 1.0, cuda=lambda: 7.0, default=lambda: 2.0)


@pytest.mark.parametrize(
    "known",
    [
        of_platform,
        jax.jit(of_platform),
        lambda: jax.lax.fori_loop(0, 3, lambda i, y: y + of_platform(), 0.0),
        lambda: by_platform(
            (TABLE[0],), TABLE[0], cpu=jnp.sin, cuda=lambda x: 7 * x, default=jnp.cos
        ),
    ],
    ids=["itself", "in a call", "in a loop", "by_platform"],
)
def test_the_platform_is_not_known_yet(known):
    folded = jax.jit(fold(lambda x: x + known()))
    same(folded(X), X + known())
    text = folded.trace(X).lower(lowering_platforms=("cuda",)).as_text()
    assert "7.0" in text
    assert "sine" not in text


def test_a_program_may_be_computed_at_once():
    """Outside of ``jax.jit`` some values of a derivative or a batch are no tracers."""

    def function(x):
        turns = jax.lax.fori_loop(0, 3, lambda i, y: (y[0] + x.sum(), y[1]), (0.0, 2.0))
        return jnp.where(x > 0, x, x[jnp.argmax(x)]) * turns[0] * jnp.sin(turns[1]) + of_platform()

    same(fold(function)(X), function(X))
    same(jax.vmap(fold(function))(MATRIX), jax.vmap(function)(MATRIX))
    grads = (
        jax.grad(lambda x, form=form: form(function)(x).sum())(X) for form in (fold, lambda f: f)
    )
    same(*grads)


def test_a_program_without_compilation_is_the_function_itself():
    with jax.disable_jit():
        same(fold(lambda x: x[FEW])(X), X[FEW])


@pytest.mark.parametrize("axis_type", [AxisType.Auto, AxisType.Explicit])
def test_arguments_may_be_sharded(axis_type):
    mesh = jax.make_mesh((1,), ("i",), axis_types=(axis_type,))
    x = jax.device_put(MATRIX, jax.NamedSharding(mesh, P("i")))
    function = jax.vmap(lambda row: row[FEW] * jnp.sin(TABLE[0]))
    same(jax.jit(fold(function))(x), jax.jit(function)(x))


@pytest.mark.parametrize("name", ["split_scan", "bind"])
def test_an_unknown_release_of_jax_is_told(monkeypatch, name):
    """As if it had other parameters."""
    monkeypatch.setattr(folding, name, lambda *_: {}["num_carry"])

    def function(x):
        return jax.lax.fori_loop(0, 3, lambda i, y: y[FEW] + jnp.sin(TABLE[0]), x)

    with pytest.warns(RuntimeWarning, match=r"jax .* has programs that PixelBrax cannot fold"):
        found = jax.jit(fold(function))(X)
    same(found, function(X))


def test_a_shard_map_that_tracks_what_varies():
    mesh = jax.make_mesh((1,), ("i",), axis_types=(AxisType.Auto,))
    function = fold(lambda x: x[FEW] * 2.0)
    sharded = jax.shard_map(function, mesh=mesh, in_specs=P("i"), out_specs=P("i"))
    np.testing.assert_array_equal(jax.jit(sharded)(X), 2 * X[FEW])


def test_derivatives_are_the_same():
    def loss(x):
        return jnp.sum(jnp.square(x[FEW] * x.at[FEW].add(1.0) @ jnp.insert(x[:2], 0, 2.0)))

    same(jax.grad(fold(loss))(X), jax.grad(loss)(X))
