"""Programs of which everything that is known while they are traced is computed then.

XLA for GPUs leaves much of that in a program, a kernel each. It also makes a kernel of each
indexing by constants, in place of slices, which it joins with what is around them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from pixelbrax_jax._platform.by_platform import num_varying
from pixelbrax_jax._platform.rules import bind, row_aval, scan_sizes

_LARGEST = 64
"""Largest number of rows, and of indices, that become slices."""

_OF_DEVICES = {"platform_index", "axis_index"}
"""Primitives without operands whose results are not known yet."""

_UNKNOWN = object()


def fold(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with the same results, up to rounding, whose program has fewer kernels.

    Within a ``jax.shard_map`` that tracks varying values it is ``function`` itself.
    """

    def folded(*args: Any) -> Any:
        leaves = jax.tree.leaves(args)
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        if any(num_varying(jax.typeof(x)) for x in (*leaves, *closed.consts)):
            return function(*args)
        # In one program: one for each result would take seconds to compile.
        constants = jax.jit(lambda: _constants(closed, leaves)).lower().compile()()
        results = _evaluate(closed, leaves, iter(constants))
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return folded


def _constants(closed: core.ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
    """Return the results of equations whose operands are known, in their order.

    A loop has one entry, for its turns.
    """
    found: list[Any] = []

    def apply(eqn: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        if _may_be_known(eqn) and not any(x is _UNKNOWN for x in inputs):
            found.append(bind(eqn, *inputs))
            return list(found[-1])
        if eqn.primitive.name == "jit":
            return _walk(eqn.params["jaxpr"], inputs, apply)
        if eqn.primitive.name == "scan":
            num_consts, _ = scan_sizes(eqn.params)
            others = [_UNKNOWN] * (len(inputs) - num_consts)
            found.append(_constants(eqn.params["jaxpr"], [*inputs[:num_consts], *others]))
        return [_UNKNOWN] * len(eqn.outvars)

    consts, operands = (
        [x if _is_known(x) else _UNKNOWN for x in values] for values in (closed.consts, operands)
    )
    _walk(core.ClosedJaxpr(closed.jaxpr, consts), operands, apply)
    return found


def _evaluate(
    closed: core.ClosedJaxpr, operands: Sequence[Any], constants: Iterator[Any]
) -> list[Any]:
    def apply(eqn: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        if _may_be_known(eqn) and all(map(_is_known, inputs)):
            return list(next(constants))
        if name == "jit":
            return _walk(eqn.params["jaxpr"], inputs, apply)
        if name == "scan":
            return _scan(eqn, inputs, next(constants))
        found = None
        if name == "gather":
            found = _gather(eqn.params["dimension_numbers"], eqn.params["slice_sizes"], *inputs)
        elif name in ("scatter", "scatter-add"):
            adds = name == "scatter-add"
            found = _scatter(eqn.params["dimension_numbers"], *inputs, adds=adds)
        return bind(eqn, *inputs) if found is None else [found]

    return _walk(closed, operands, apply)


def _scan(eqn: core.JaxprEqn, inputs: list[Any], constants: list[Any]) -> list[Any]:
    params = eqn.params
    num_consts, num_carry = scan_sizes(params)
    stop = num_consts + num_carry

    def turn(carried: list[Any], slices: list[Any]) -> tuple[list[Any], list[Any]]:
        operands = [*inputs[:num_consts], *carried, *slices]
        results = _evaluate(params["jaxpr"], operands, iter(constants))
        return results[:num_carry], results[num_carry:]

    options = {name: params[name] for name in ("length", "reverse", "unroll")}
    last, ys = lax.scan(turn, inputs[num_consts:stop], inputs[stop:], **options)
    return [*last, *ys]


def _walk(
    closed: core.ClosedJaxpr,
    operands: Sequence[Any],
    apply: Callable[[core.JaxprEqn, list[Any]], list[Any]],
) -> list[Any]:
    """Return the results of a program, each equation of which ``apply`` computes."""
    values: dict[core.Var, Any] = {}

    def read(atom: core.Var | core.Literal) -> Any:
        if isinstance(atom, core.Literal):
            return np.asarray(atom.val, row_aval(atom).dtype)
        return values[atom]

    values.update(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    values.update(zip(closed.jaxpr.invars, operands, strict=True))
    for eqn in closed.jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        with eqn.ctx.manager:
            values.update(zip(eqn.outvars, apply(eqn, inputs), strict=True))
    return [read(atom) for atom in closed.jaxpr.outvars]


def _may_be_known(eqn: core.JaxprEqn) -> bool:
    return eqn.primitive.name not in _OF_DEVICES and not eqn.effects


def _is_known(value: Any) -> bool:
    return not isinstance(value, jax.core.Tracer)


def _gather(numbers: Any, slice_sizes: tuple[int, ...], x: Any, indices: Any) -> Any:
    """Return ``x`` at constant indices of one axis, by slices; None if it indexes otherwise."""
    axes = numbers.start_index_map
    rows = _rows(indices, axes, numbers.operand_batching_dims, x.shape)
    whole = tuple(1 if axis in axes else size for axis, size in enumerate(x.shape))
    if rows is None or numbers.collapsed_slice_dims != axes or slice_sizes != whole:
        return None
    x = jnp.moveaxis(x, axes[0], 0)
    taken = lax.concatenate([lax.slice_in_dim(x, row, row + 1) for row in rows.flat], 0)
    taken = taken.reshape(*rows.shape, *x.shape[1:])
    to = [axis for axis in range(taken.ndim) if axis not in numbers.offset_dims]
    return jnp.moveaxis(taken, range(taken.ndim), [*to, *numbers.offset_dims])


def _scatter(numbers: Any, x: Any, indices: Any, updates: Any, *, adds: bool) -> Any:
    """Return ``x`` with rows at constant indices replaced or increased; None as ``_gather``."""
    axes = numbers.scatter_dims_to_operand_dims
    rows = _rows(indices, axes, numbers.operand_batching_dims, x.shape)
    window = numbers.update_window_dims
    whole = tuple(size for axis, size in enumerate(x.shape) if axis not in axes)
    sizes = tuple(updates.shape[axis] for axis in window)
    if rows is None or numbers.inserted_window_dims != axes or sizes != whole:
        return None
    batch = [axis for axis in range(updates.ndim) if axis not in window]
    updates = updates.transpose(*batch, *window).reshape(rows.size, *whole)
    x = jnp.moveaxis(x, axes[0], 0)
    result = [lax.slice_in_dim(x, row, row + 1) for row in range(len(x))]
    for update, row in enumerate(rows.flat):
        new = lax.slice_in_dim(updates, update, update + 1)
        result[row] = result[row] + new if adds else new
    return jnp.moveaxis(lax.concatenate(result, 0), 0, axes[0])


def _rows(
    indices: Any, axes: tuple[int, ...], batching: Sequence[int], shape: tuple[int, ...]
) -> Any:
    """Return constant indices of one axis; None for others, too many, or any out of bounds."""
    if len(axes) != 1 or batching or not _is_known(indices):
        return None
    rows, size = np.asarray(indices)[..., 0], shape[axes[0]]
    is_small = 0 < rows.size <= _LARGEST and size <= _LARGEST
    return rows if is_small and bool(np.all((rows >= 0) & (rows < size))) else None
