"""A program traces the form of its platform, and no other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax._platform.by_platform import by_platform

ROW = {"x": jnp.arange(3.0), "n": jnp.arange(3)}


def program(traced):
    """A function that is doubled on a CPU, tripled by CUDA, and appends to `traced` what it is."""

    def times(name, factor):
        def form(row, scale):
            traced.append(name)
            return {"y": factor * scale * row["x"], "n": row["n"]}

        return form

    def compute(row, scale):
        like = {"y": row["x"], "n": row["n"]}
        forms = {"cpu": times("cpu", 2.0), "cuda": times("cuda", 3.0)}
        return by_platform((row, scale), like, default=times("default", 4.0), **forms)

    return compute


@pytest.mark.parametrize(
    ("platform", "name"), [("cpu", "cpu"), ("cuda", "cuda"), ("tpu", "default")]
)
@pytest.mark.parametrize("rows", [0, 1, 2])
def test_only_the_form_of_the_platform_is_traced(platform, name, rows):
    traced, row = [], ROW
    compute = program(traced)
    for _ in range(rows):
        compute = jax.vmap(compute, in_axes=({"x": 0, "n": None}, None))
        row = {"x": jnp.stack([row["x"], 1.0 - row["x"]]), "n": row["n"]}
    jax.jit(compute).trace(row, 1.0).lower(lowering_platforms=(platform,))
    assert traced == [name]


def test_a_batch_is_that_of_the_form_with_what_is_shared():
    compute = jax.vmap(program([]), in_axes=({"x": None, "n": 1}, 0))
    numbers = jnp.arange(6).reshape(3, 2)
    results = jax.jit(compute)({"x": ROW["x"], "n": numbers}, jnp.asarray([1.0, 10.0]))
    np.testing.assert_array_equal(results["y"], [[0, 2, 4], [0, 20, 40]])
    np.testing.assert_array_equal(results["n"], numbers.T)


def test_derivatives_are_those_of_the_form_and_integers_have_none():
    traced = []
    compute = program(traced)
    gradient = jax.grad(lambda scale: jnp.sum(compute(ROW, scale)["y"]))
    assert jax.jit(gradient)(1.0) == gradient(1.0) == 6.0
    _, change = jax.jvp(lambda x: compute({**ROW, "x": x}, 5.0), (ROW["x"],), (jnp.ones(3),))
    np.testing.assert_array_equal(change["y"], [10, 10, 10])
    assert change["n"].dtype == jax.dtypes.float0
    assert set(traced) == {"cpu", "cuda", "default"}


def test_a_derivative_may_be_refused():
    def compute(x):
        return by_platform((x,), x, default=jnp.sin, no_derivative="there is none")

    with pytest.raises(NotImplementedError, match="there is none"):
        jax.grad(compute)(1.0)
    assert compute(jnp.float32(0.0)) == 0.0


def test_forms_are_traced_under_the_flags_of_all_programs():
    with jax.enable_x64(True):
        found = []
        like = jax.ShapeDtypeStruct((), jnp.float32)

        def form(x):
            found.append(jax.config.jax_enable_x64)
            return x * jnp.ones(())

        assert jax.jit(lambda x: by_platform((x,), like, default=form))(np.float32(2)) == 2.0
        assert found == [False]


def test_a_form_with_other_results_is_an_error():
    with pytest.raises(AssertionError, match="in place of"):
        jax.jit(lambda x: by_platform((x,), x, default=lambda x: x[:2]))(jnp.zeros(3))


def test_a_key_is_used_only_by_a_form_that_draws_with_it():
    def draw(key):
        return jax.random.randint(key, (), 0, 9)

    def twice(key, form):
        return by_platform((key,), jnp.int32(0), default=form) + draw(key)

    with jax.debug_key_reuse(True):
        one = jax.jit(partial(twice, form=lambda key: jnp.int32(1)))(jax.random.key(0))
        assert one == 1 + draw(jax.random.key(0))
        with pytest.raises(jax.errors.KeyReuseError):
            jax.jit(partial(twice, form=draw))(jax.random.key(0))
