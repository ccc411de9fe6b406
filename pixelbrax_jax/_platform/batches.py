"""Functions of one row mapped over a batch, in the fastest form for the device."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax._platform.by_platform import by_platform, traced_row
from pixelbrax_jax._platform.interpreter import batch_last

_CHUNK = 128
"""Largest number of rows that a CPU computes together, to keep results in its caches."""

_RAYS = 2**18
"""Approximate number of rays that a CPU computes together. More than 32 MB of intermediate results
would be mapped into memory anew in every call."""

Step = Callable[..., tuple[Any, jax.Array]]


def step_rows(step: Step, state: Any, rows: Any, shared: Any) -> tuple[Any, jax.Array]:
    """Step every row of a batch, as ``jax.vmap(step, (0, 0, None))(state, rows, shared)``.

    A CPU steps chunks of rows, with the rows as last axis of intermediate results (see
    ``batch_last``); results differ from those of ``jax.vmap`` by rounding. ``step`` returns a row's
    next state, with the same tree, and a () float32.
    """
    together = jax.vmap(step, in_axes=(0, 0, None))
    num_rows = len(jax.tree.leaves(state)[0])
    if num_rows == 1:
        return together(state, rows, shared)
    in_chunks = partial(_step_chunks, step)
    like = (state, jax.ShapeDtypeStruct((num_rows,), jnp.float32))
    return by_platform((state, rows, shared), like, cpu=in_chunks, default=together)


def draw_rows(draw: Callable[..., Any], arguments: tuple[Any, ...], rays: int) -> Any:
    """Return ``jax.vmap(draw)(*arguments)``, the images of every row of a batch.

    A CPU draws a few rows, of ``rays`` each, at a time to limit intermediate results; some twice.
    """
    num_rows = len(jax.tree.leaves(arguments)[0])
    size = -(-num_rows // -(-num_rows * rays // _RAYS))
    turns = -(-num_rows // size)
    if turns == 1:
        return jax.vmap(draw)(*arguments)
    program, compute, like = traced_row(draw, *arguments)

    def together(consts: list[Any], *arguments: Any) -> Any:
        return jax.vmap(partial(compute, consts))(*arguments)

    def in_turns(consts: list[Any], *arguments: Any) -> Any:
        def put(i: jax.Array, images: Any) -> Any:
            first = i * size  # JAX moves it back if the last turn would exceed the end
            rows = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, size), arguments)
            return jax.tree.map(
                lambda x, drawn: jax.lax.dynamic_update_slice_in_dim(x, drawn, first, 0),
                images,
                together(consts, *rows),
            )

        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        return jax.lax.fori_loop(0, turns, put, blank)

    return by_platform((program.consts, *arguments), like, cpu=in_turns, default=together)


def map_runs(function: Callable[[Any], Any], runs: Any) -> Any:
    """Return ``jax.vmap(function)(runs)``; on a CPU one run after the other."""
    program, compute, like = traced_row(function, runs)
    return by_platform(
        (program.consts, runs),
        like,
        cpu=lambda consts, runs: jax.lax.map(partial(compute, consts), runs),
        default=lambda consts, runs: jax.vmap(partial(compute, consts))(runs),
    )


def one_run_after_the_other(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``function`` with ``map_runs`` in place of ``jax.vmap``; it has no gradient."""
    mapped = jax.custom_batching.custom_vmap(function)

    @mapped.def_vmap
    def map_all(size: int, batched: Any, *arguments: Any) -> tuple[Any, Any]:
        def spread(x: jax.Array, is_batched: bool) -> jax.Array:
            return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

        arguments = jax.tree.map(spread, arguments, tuple(batched))
        result = map_runs(lambda one: function(*one), arguments)
        return result, jax.tree.map(lambda _: True, result)

    return mapped


def _step_chunks(step: Step, state: Any, rows: Any, shared: Any) -> tuple[Any, jax.Array]:
    num_rows = len(jax.tree.leaves(state)[0])
    step_chunk = batch_last(step, in_axes=(0, 0, None))
    size = chunk_size(num_rows)
    if size == num_rows:
        return step_chunk(state, rows, shared)

    # Sizes are explicit, because an empty array (some engines have one) allows no -1.
    def chunks(x: jax.Array) -> jax.Array:
        return x.reshape(num_rows // size, size, *x.shape[1:])

    states, rows = jax.tree.map(chunks, (state, rows))

    def put(i: jax.Array, carry: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
        chunk = jax.tree.map(lambda x: x[i], (carry[0], rows))
        moved = step_chunk(*chunk, shared)
        return jax.tree.map(lambda x, new: x.at[i].set(new), carry, moved)

    # In place, because `jax.lax.map` would clear its results first and copy them afterwards.
    carry = (states, jnp.zeros((num_rows // size, size), jnp.float32))
    moved = jax.lax.fori_loop(0, num_rows // size, put, carry)
    return jax.tree.map(lambda x: x.reshape(num_rows, *x.shape[2:]), moved)


def chunk_size(num_rows: int) -> int:
    """Return the largest divisor of ``num_rows`` from ``_CHUNK / 2`` to ``_CHUNK``, else all."""
    sizes = range(min(_CHUNK, num_rows), _CHUNK // 2 - 1, -1)
    return next((size for size in sizes if num_rows % size == 0), num_rows)
