"""Small linear systems, in operations that a device does for a whole batch."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

LARGEST = 17
"""Largest number of unknowns that a CPU eliminates, where LAPACK is slower, one matrix after the
other, and that a GPU eliminates without a loop."""


def solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve ``matrix @ x = right``, by elimination or by Cholesky's factors.

    An NVIDIA GPU eliminates, because XLA captures no factorization in a CUDA graph: the host would
    launch each one. A CPU eliminates up to ``LARGEST`` unknowns.

    ``matrix`` is (V, V) float32, symmetric and positive definite, so that no pivoting is needed;
    other matrices give NaN. ``right`` and ``x`` are (V,) float32.
    """
    is_small = len(matrix) <= LARGEST
    found: jax.Array = jax.lax.platform_dependent(
        matrix,
        right,
        cpu=eliminate if is_small else _by_factors,
        cuda=partial(eliminate, unroll=is_small),
        default=_by_factors,
    )
    return found


def _by_factors(matrix: jax.Array, right: jax.Array) -> jax.Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)


def eliminate(matrix: jax.Array, right: jax.Array, *, unroll: bool = False) -> jax.Array:
    """Solve by elimination, without a loop if ``unroll``; see ``solve``."""

    def turn(i: jax.Array, rows: jax.Array) -> jax.Array:
        # NaN like Cholesky's factors, so that a diverged state is noticed.
        pivot = rows[i] / jnp.where(rows[i, i] > 0, rows[i, i], jnp.nan)
        is_pivot = (jnp.arange(len(rows)) == i)[:, None]
        return jnp.where(is_pivot, pivot, rows - rows[:, i][:, None] * pivot)

    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    return jax.lax.fori_loop(0, len(rows), turn, rows, unroll=unroll)[:, -1]
