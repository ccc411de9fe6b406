"""Linear equations of a few unknowns, in steps that a batch on a CPU takes together."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax._platform.lowering import by_platform

LARGEST = 17
"""Unknowns up to which elimination takes less time on a CPU than LAPACK, matrix by matrix."""


def solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve ``matrix @ x = right``: few unknowns on a CPU by elimination, else by factors.

    Args:
        matrix: (V, V) float32, symmetric and positive definite, so that no rows need exchanging.
        right: (V,) float32.

    Returns:
        x, (V,) float32; NaN for a matrix of another kind.
    """
    if len(matrix) > LARGEST:
        return _by_factors(matrix, right)
    return by_platform(matrix, right, cpu=eliminate, default=_by_factors)


def _by_factors(matrix: jax.Array, right: jax.Array) -> jax.Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)


def eliminate(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve as ``solve`` does, by elimination."""

    def turn(i: jax.Array, rows: jax.Array) -> jax.Array:
        # As Cholesky's factors are: a state that has diverged shall be seen as such.
        pivot = rows[i] / jnp.where(rows[i, i] > 0, rows[i, i], jnp.nan)
        is_pivot = (jnp.arange(len(rows)) == i)[:, None]
        return jnp.where(is_pivot, pivot, rows - rows[:, i][:, None] * pivot)

    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    return jax.lax.fori_loop(0, len(rows), turn, rows)[:, -1]
