"""Linear equations of small matrices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax._platform.interpreter import batch_last
from pixelbrax_jax.physics.mjx import elimination


@pytest.mark.parametrize("unknowns", [1, 3, elimination.LARGEST, elimination.LARGEST + 1])
@pytest.mark.parametrize(
    "batch", [jax.vmap, lambda f: batch_last(f, (0, 0))], ids=["first", "last"]
)
def test_solutions_are_numpys(unknowns, batch):
    random = np.random.default_rng(unknowns)
    root = random.normal(size=(32, unknowns, unknowns))
    scale = 10.0 ** random.uniform(-1, 1, (32, unknowns, 1))  # As masses of fingers and torsos.
    matrix = scale * (root @ root.mT + np.eye(unknowns)) * scale.mT
    right = random.normal(size=(32, unknowns))
    found = jax.jit(batch(elimination.solve))(
        jnp.asarray(matrix, jnp.float32), jnp.asarray(right, jnp.float32)
    )
    expected = np.linalg.solve(matrix, right[..., None])[..., 0]
    error = np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1)
    assert error.max() < 1e-3
    assert np.median(error) < 1e-5


@pytest.mark.parametrize("unknowns", [2, elimination.LARGEST + 1])
def test_matrices_of_other_kinds_have_no_solution(unknowns):
    matrix = jnp.diag(jnp.ones(unknowns).at[1].set(-1.0))
    assert jnp.isnan(elimination.solve(matrix, jnp.ones(unknowns))).all()
