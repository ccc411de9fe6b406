"""Functions of one row that are traced only for the device that a program is lowered for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


class RowFunction(Protocol):
    """A function of float32 arrays in two forms. It is hashable: equal ones compute the same.

    ``jax.lax.platform_dependent`` traces all forms, and MuJoCo XLA takes many seconds to trace.
    """

    @property
    def shapes(self) -> Sequence[tuple[int, ...]]:
        """The shapes of the float32 results of one row."""

    no_derivative: ClassVar[str]
    """Why it has no derivative; the message of the error."""

    def on_cpu(self, *rows: jax.Array) -> Sequence[jax.Array]:
        """Compute (N, ...) results of (N, ...) rows."""

    def elsewhere(self, *row: jax.Array) -> Sequence[jax.Array]:
        """Compute the results of one row."""


def call(function: RowFunction, *arrays: jax.Array) -> list[jax.Array]:
    """Return the results of one row; the form is chosen when the program is lowered."""
    return _primitive.bind(*arrays, function=function, batch=())


_primitive = Primitive("row_function")
_primitive.multiple_results = True


@_primitive.def_impl
def _compute(*arrays: Any, **params: Any) -> Any:
    return jax.jit(partial(_primitive.bind, **params))(*arrays)


@_primitive.def_abstract_eval
def _shapes(*avals: Any, function: RowFunction, batch: tuple[int, ...]) -> list[Any]:
    return [avals[0].update(shape=(*batch, *s), dtype=jnp.float32.dtype) for s in function.shapes]


def _batch(arrays: Any, axes: Any, *, function: RowFunction, batch: tuple[int, ...]) -> Any:
    sizes = {x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None}
    (size,) = sizes
    rows = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    results = _primitive.bind(*rows, function=function, batch=(size, *batch))
    return results, [0] * len(results)


def _derivative(*args: Any, function: RowFunction, **params: Any) -> Any:
    del args, params
    raise NotImplementedError(function.no_derivative)


def _flat(method: Any, batch: tuple[int, ...]) -> Any:
    """Return ``method`` of (N, ...) rows for arrays with any batch axes in front."""

    def of_batch(*arrays: jax.Array) -> list[jax.Array]:
        size = math.prod(batch)
        rows = [x.reshape(size, *x.shape[len(batch) :]) for x in arrays]
        return [x.reshape(*batch, *x.shape[1:]) for x in method(*rows)]

    return of_batch


def _lower_on_cpu(ctx: Any, *values: Any, function: RowFunction, batch: tuple[int, ...]) -> Any:
    rule = mlir.lower_fun(_flat(function.on_cpu, batch), multiple_results=True)
    return rule(ctx, *values)


def _lower_elsewhere(ctx: Any, *values: Any, function: RowFunction, batch: tuple[int, ...]) -> Any:
    method = _flat(jax.vmap(function.elsewhere), batch) if batch else function.elsewhere
    return mlir.lower_fun(method, multiple_results=True)(ctx, *values)


batching.primitive_batchers[_primitive] = _batch
ad.primitive_jvps[_primitive] = _derivative
mlir.register_lowering(_primitive, _lower_on_cpu, platform="cpu")
mlir.register_lowering(_primitive, _lower_elsewhere)
