"""Linear equations of a few unknowns, in steps that a batch on a CPU takes together."""

from __future__ import annotations

import jax
import jax.numpy as jnp

LARGEST = 17
"""Unknowns up to which elimination takes less time on a CPU than LAPACK, matrix by matrix."""


def is_faster(unknowns: int) -> bool:
    """Return whether elimination is faster than factorisation, on JAX's default device."""
    return unknowns <= LARGEST and jax.default_backend() == "cpu"


def solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve ``matrix @ x = right``, by elimination where that is faster, else by factors.

    Args:
        matrix: (V, V) float32, symmetric and positive definite, so that no rows need exchanging.
        right: (V,) float32.

    Returns:
        x, (V,) float32; NaN for a matrix of another kind.
    """
    if not is_faster(len(matrix)):
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)

    def eliminate(i: jax.Array, rows: jax.Array) -> jax.Array:
        # As Cholesky's factors are: a state that has diverged shall be seen as such.
        pivot = rows[i] / jnp.where(rows[i, i] > 0, rows[i, i], jnp.nan)
        is_pivot = (jnp.arange(len(rows)) == i)[:, None]
        return jnp.where(is_pivot, pivot, rows - rows[:, i][:, None] * pivot)

    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    return jax.lax.fori_loop(0, len(rows), eliminate, rows)[:, -1]
