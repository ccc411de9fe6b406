"""Small linear systems, solved by operations on a whole batch."""

from __future__ import annotations

import jax
import jax.numpy as jnp

LARGEST = 17
"""Largest number of unknowns that a CPU eliminates, because LAPACK takes one matrix after the
other, and that a GPU eliminates without a loop."""

IN_ONE_KERNEL = 9
"""Largest number of unknowns that a GPU eliminates in one kernel. Nine take three seconds to
compile, seventeen half a minute."""


def solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve ``matrix @ x = right``, by elimination or by Cholesky's factors.

    An NVIDIA GPU eliminates, because XLA captures no factorization in a CUDA graph: the host would
    launch each one. A CPU eliminates up to ``LARGEST`` unknowns.

    ``matrix`` is (V, V) float32, symmetric and positive definite, so that no pivoting is needed;
    other matrices give NaN. ``right`` and ``x`` are (V,) float32.
    """
    found: jax.Array = jax.lax.platform_dependent(
        matrix,
        right,
        cpu=eliminate if len(matrix) <= LARGEST else _by_factors,
        cuda=on_cuda,
        default=_by_factors,
    )
    return found


def on_cuda(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Return what ``solve`` does on an NVIDIA GPU."""
    if len(matrix) <= IN_ONE_KERNEL:
        return eliminate_by_entry(matrix, right)
    return eliminate(matrix, right, unroll=len(matrix) <= LARGEST)


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


def eliminate_by_entry(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve by elimination, one operation for each entry; see ``solve``.

    XLA for GPUs makes one kernel of them. Only the lower triangle is read.
    """
    count = len(right)
    rows = [[*(matrix[i, j] for j in range(i + 1)), right[i]] for i in range(count)]
    for k in range(count):
        rows[k][k] = jnp.where(rows[k][k] > 0, rows[k][k], jnp.nan)
        for i in range(k + 1, count):
            factor = rows[i][k] / rows[k][k]
            for j in range(k + 1, i + 1):
                rows[i][j] -= factor * rows[j][k]
            rows[i][-1] -= factor * rows[k][-1]
    found = [jnp.zeros(())] * count
    for k in reversed(range(count)):
        known = sum(rows[i][k] * found[i] for i in range(k + 1, count))
        found[k] = (rows[k][-1] - known) / rows[k][k]
    return jnp.stack(found)
