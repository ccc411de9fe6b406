"""Fold constants while a program is traced, and replace constant indices by slices.

XLA for GPUs does neither, and runs a kernel for each.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core
from jax.sharding import AxisType

from pixelbrax_jax._platform.by_platform import num_varying
from pixelbrax_jax._platform.programs import bind, interpret, split_scan

_MOST_ROWS = 64
"""Largest number of rows, and of indices, that become slices."""

_KNOWN_LATER = {"by_platform", "platform_index"}
"""Primitives whose results depend on the device that a program is lowered for."""

_UNKNOWN = object()


class _Found(NamedTuple):
    """Results of an equation; None for those that no equation of the program reads."""

    results: list[Any]


class _Inner(NamedTuple):
    """The plan of an equation's inner program: a call or a loop's body."""

    plan: _Plan


_Plan = list[_Found | _Inner | None]
"""One entry for each equation of a program; None if it is neither known nor contains a program."""


def fold(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with the same results, up to rounding and weak types.

    It takes only positional arguments. Bodies of ``while`` loops and branches are not folded. The
    function itself runs under ``jax.disable_jit``, for arguments on a mesh with explicit axes or
    tracked by ``jax.shard_map``, and, with a RuntimeWarning, if JAX has unknown programs.
    """

    def folded(*args: Any) -> Any:
        if getattr(jax.config, "jax_disable_jit", False):
            return function(*args)
        leaves = jax.tree.leaves(args)
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        if any(map(_is_sharded, (*leaves, *closed.consts))):
            return function(*args)
        # An unknown release of JAX must not fail; `make_jaxpr` above raised the user's own errors.
        try:
            # One program, because one for each result would take seconds to compile.
            plan = jax.jit(lambda: _plan(closed, [*map(_known, leaves)])[0]).lower().compile()()
            results = _evaluate(closed, leaves, plan)
        except Exception as error:
            warnings.warn(
                f"jax {jax.__version__} has programs that PixelBrax cannot fold "
                f"({type(error).__name__}: {error}). Results are as good, and a GPU launches more "
                "kernels.",
                RuntimeWarning,
                stacklevel=1,  # one line, so that Python warns once
            )
            return function(*args)
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return folded


def _known(x: Any) -> Any:
    return _UNKNOWN if isinstance(x, jax.core.Tracer) else x


def _plan(closed: core.ClosedJaxpr, operands: Sequence[Any]) -> tuple[_Plan, list[Any]]:
    """Return the plan of a program, and its results, some of which are ``_UNKNOWN``."""
    plan: _Plan = []
    read_later = {id(atom) for atom in closed.jaxpr.outvars}

    def apply(eqn: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        results = [_UNKNOWN] * len(eqn.outvars)
        entry: _Found | _Inner | None = None
        if not any(x is _UNKNOWN for x in inputs) and _may_be_known(eqn):
            results = bind(eqn, *inputs)
            entry = _Found(results)
        elif eqn.primitive.name == "jit":
            found, results = _plan(eqn.params["jaxpr"], inputs)
            entry = _Inner(found)
        elif eqn.primitive.name == "scan":
            consts, carry, xs = split_scan(eqn.params, inputs)
            others = [_UNKNOWN] * len([*carry, *xs])
            entry = _Inner(_plan(eqn.params["jaxpr"], [*consts, *others])[0])
        if not isinstance(entry, _Found):
            read_later.update(map(id, eqn.invars))
        plan.append(entry)
        return results

    results = interpret(closed, operands, apply, _known)
    for i, (eqn, entry) in enumerate(zip(closed.jaxpr.eqns, plan, strict=True)):
        if isinstance(entry, _Found):
            pairs = zip(eqn.outvars, entry.results, strict=True)
            plan[i] = _Found([x if id(var) in read_later else None for var, x in pairs])
    return plan, results


def _evaluate(closed: core.ClosedJaxpr, operands: Sequence[Any], plan: _Plan) -> list[Any]:
    entries = iter(plan)

    def apply(eqn: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        entry = next(entries)
        return entry.results if isinstance(entry, _Found) else _apply(eqn, inputs, entry)

    return interpret(closed, operands, apply, lambda x: x)


def _apply(eqn: core.JaxprEqn, inputs: list[Any], entry: _Inner | None) -> list[Any]:
    name, params = eqn.primitive.name, eqn.params
    if entry is not None and name == "scan":
        return _scan(params, inputs, entry.plan)
    if entry is not None:
        return _evaluate(params["jaxpr"], inputs, entry.plan)
    found = None
    if name == "gather":
        found = _gather(params["dimension_numbers"], params["slice_sizes"], *inputs)
    elif name in ("scatter", "scatter-add"):
        adds = name == "scatter-add"
        found = _scatter(params["dimension_numbers"], *inputs, adds=adds)
    return bind(eqn, *inputs) if found is None else [found]


def _scan(params: Any, inputs: list[Any], plan: _Plan) -> list[Any]:
    consts, carry, xs = split_scan(params, inputs)

    def turn(carried: list[Any], slices: list[Any]) -> tuple[list[Any], list[Any]]:
        results = _evaluate(params["jaxpr"], [*consts, *carried, *slices], plan)
        return results[: len(carry)], results[len(carry) :]

    options = {name: params[name] for name in ("length", "reverse", "unroll")}
    last, ys = lax.scan(turn, carry, xs, **options)
    return [*last, *ys]


def _may_be_known(eqn: core.JaxprEqn) -> bool:
    if eqn.primitive.name in _KNOWN_LATER or eqn.effects:
        return False
    return all(
        _may_be_known(inner) for sub in core.jaxprs_in_params(eqn.params) for inner in sub.eqns
    )


def _is_sharded(x: Any) -> bool:
    aval = jax.typeof(x)
    mesh = getattr(getattr(aval, "sharding", None), "mesh", None)
    return num_varying(aval) > 0 or AxisType.Explicit in getattr(mesh, "axis_types", ())


def _gather(numbers: Any, slice_sizes: tuple[int, ...], x: Any, indices: Any) -> Any:
    """Return ``x`` at constant indices of one axis, by slices; None for other indices."""
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
    """Return ``x`` with rows at constant indices replaced or increased; None for others."""
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
    if len(axes) != 1 or batching or isinstance(indices, jax.core.Tracer):
        return None
    rows, size = np.asarray(indices)[..., 0], shape[axes[0]]
    is_small = 0 < rows.size <= _MOST_ROWS and size <= _MOST_ROWS
    return rows if is_small and bool(np.all((rows >= 0) & (rows < size))) else None
