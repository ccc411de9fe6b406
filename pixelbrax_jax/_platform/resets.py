"""Work for some rows of a batch, such as environments that are reset."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core

from pixelbrax_jax._platform.by_platform import by_platform, traced_row

_BLOCK = 32
"""Environments that are reset together; their number is rounded up to a multiple."""


def reset_rows(
    fn: Callable[..., Any], arguments: tuple[Any, ...], mask: jax.Array, rows: Any
) -> Any:
    """Return ``rows``, reset where ``mask`` is set. Arguments are those of ``replace_rows``.

    A CPU resets only the masked rows, in a loop whose length depends on the mask. An accelerator
    would wait for the host in every iteration, so it resets all rows and selects, unless the reset
    contains a loop that waits in any case.
    """
    program, compute, _ = traced_row(fn, *arguments)
    if _has_open_loop(program.jaxpr):
        return replace_rows(partial(compute, program.consts), arguments, mask, rows)
    return by_platform(
        (program.consts, arguments, mask, rows),
        rows,
        cpu=lambda consts, *rest: replace_rows(partial(compute, consts), *rest),
        default=lambda consts, *rest: _select_rows(partial(compute, consts), *rest),
    )


def replace_rows(
    fn: Callable[..., Any], arguments: tuple[Any, ...], mask: jax.Array, rows: Any
) -> Any:
    """Return ``rows``, replaced by ``fn`` of the arguments' rows where ``mask``, (N,) bool, is set.

    The work is done in blocks and grows with the number of masked rows, not with N: most steps end
    no episode. The loop carries the remaining rows. With a counter instead, XLA would move work
    that all blocks share, such as physics at the initial pose, out of the loop into every step.
    """
    num_rows = mask.shape[0]
    if num_rows == 1:
        # XLA would move everything out of a loop.
        return jax.lax.cond(mask[0], lambda: jax.vmap(fn)(*arguments), lambda: rows)
    block = min(_BLOCK, num_rows)

    def put(carry: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        left, rows = carry
        # Indices past the end read the last row, and are never written.
        index = jnp.nonzero(left, size=block, fill_value=num_rows)[0]
        inputs = jax.tree.map(lambda x: jnp.take(x, index, axis=0, mode="clip"), arguments)
        outputs = jax.vmap(fn)(*inputs)
        rows = jax.tree.map(lambda x, new: x.at[index].set(new, mode="drop"), rows, outputs)
        return left.at[index].set(False, mode="drop"), rows

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), put, (mask, rows))[1]


def _select_rows(
    fn: Callable[..., Any], arguments: tuple[Any, ...], mask: jax.Array, rows: Any
) -> Any:

    def select(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(select, jax.vmap(fn)(*arguments), rows)


def _has_open_loop(jaxpr: Any) -> bool:
    """Return whether a program has a loop whose length depends on data."""
    return any(
        eqn.primitive.name == "while" or any(map(_has_open_loop, core.jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )
