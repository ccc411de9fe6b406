"""Rules for JAX's primitives with the batch as last axis."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core

from pixelbrax_jax._platform.programs import bind, row_aval

FEW = 4
"""Largest number of rows without padding and inlined matrix products: short loops gain nothing."""

_LONGEST_SUM = 16
"""Longest axis of matrix products that are written as sums; longer ones call a library."""


class Operand(NamedTuple):
    """A value for every row, with the batch as last axis, or one for all rows."""

    value: Any
    batched: bool


Rule = Callable[[core.JaxprEqn, Sequence[Operand], int], "list[Any] | None"]
"""``rule(eqn, inputs, size)`` returns results with ``size`` rows as last axis, or None for
unsupported inputs. At least one input is batched."""

RULES: dict[str, Rule] = {}
"""Rules by primitive. ``jax.vmap`` computes primitives without a rule."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register the rule of some primitives."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


def _rule_of_first(name: str) -> Callable[..., Callable[..., jax.Array]]:
    """Register a rule for a batched first operand and shared others."""

    def register(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
        def apply(eqn: core.JaxprEqn, inputs: Sequence[Operand], _size: int) -> list[Any] | None:
            first, *others = inputs
            if not first.batched or any(x.batched for x in others):
                return None
            return [function(eqn, *(x.value for x in inputs))]

        RULES[name] = apply
        return function

    return register


def spread(operand: Operand, shape: tuple[int, ...], size: int) -> jax.Array:
    """Return the operand as (*shape, size); its row has ``shape`` or is a scalar."""
    rank = jnp.ndim(operand.value) - operand.batched
    axes = tuple(range(rank)) + ((len(shape),) if operand.batched else ())
    if operand.batched and rank == len(shape):
        return operand.value
    return lax.broadcast_in_dim(operand.value, (*shape, size), axes)


_ELEMENTWISE_NAMES = """
abs acos add and asin atan atan2 cbrt ceil clamp convert_element_type copy copy_p cos cosh div eq
erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg
nextafter not or pow reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic
shift_right_logical sign sin sinh sqrt square sub tan tanh xor
"""


@rule(*_ELEMENTWISE_NAMES.split())
def _elementwise(eqn: core.JaxprEqn, inputs: Sequence[Operand], size: int) -> list[Any]:
    shape = row_aval(eqn.outvars[0]).shape
    return bind(eqn, *(spread(x, shape, size) for x in inputs))


_NAMED_AXES_NAMES = """
argmax argmin cumlogsumexp cummax cummin cumprod cumsum reduce_and reduce_max reduce_min reduce_or
reduce_prod reduce_sum rev split squeeze unstack
"""


@rule(*_NAMED_AXES_NAMES.split())
def _named_axes(eqn: core.JaxprEqn, inputs: Sequence[Operand], _size: int) -> list[Any]:
    """Bind unchanged: parameters name the axes, and one more at the end does not matter."""
    return bind(eqn, *(x.value for x in inputs))


@rule("concatenate", "stack")
def _join(eqn: core.JaxprEqn, inputs: Sequence[Operand], size: int) -> list[Any]:
    parts = zip(inputs, eqn.invars, strict=True)
    joined = bind(eqn, *(spread(x, row_aval(atom).shape, size) for x, atom in parts))
    # Without the barrier XLA reads the parts instead of slices of the whole, and computes them
    # again in each kernel that reads one.
    return list(lax.optimization_barrier(joined))


@_rule_of_first("broadcast_in_dim")
def _broadcast(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    shape = eqn.params["shape"]
    axes = (*eqn.params["broadcast_dimensions"], len(shape))
    return lax.broadcast_in_dim(x, (*shape, x.shape[-1]), axes)


@_rule_of_first("reshape")
def _reshape(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    order = eqn.params["dimensions"]
    order = None if order is None else (*order, x.ndim - 1)
    return lax.reshape(x, (*eqn.params["new_sizes"], x.shape[-1]), order)


@_rule_of_first("transpose")
def _transpose(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    return lax.transpose(x, (*eqn.params["permutation"], x.ndim - 1))


@_rule_of_first("tile")
def _tile(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    return lax.tile(x, (*eqn.params["reps"], 1))


@_rule_of_first("slice")
def _slice(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    strides = eqn.params["strides"] or (1,) * (x.ndim - 1)
    start, limit = eqn.params["start_indices"], eqn.params["limit_indices"]
    return lax.slice(x, (*start, 0), (*limit, x.shape[-1]), (*strides, 1))


@_rule_of_first("dynamic_slice")
def _dynamic_slice(eqn: core.JaxprEqn, x: jax.Array, *start: jax.Array) -> jax.Array:
    # Bound directly, because `lax.dynamic_slice` would count negative indices from the end again.
    zero = jnp.zeros((), start[0].dtype if start else jnp.int32)
    sizes = (*eqn.params["slice_sizes"], x.shape[-1])
    return bind(eqn, x, *start, zero, slice_sizes=sizes)[0]


@_rule_of_first("pad")
def _pad(eqn: core.JaxprEqn, x: jax.Array, padding: jax.Array) -> jax.Array:
    return lax.pad(x, padding, (*eqn.params["padding_config"], (0, 0, 0)))


@_rule_of_first("gather")
def _gather(eqn: core.JaxprEqn, x: jax.Array, indices: jax.Array) -> jax.Array:
    numbers = eqn.params["dimension_numbers"]
    numbers = numbers._replace(offset_dims=(*numbers.offset_dims, row_aval(eqn.outvars[0]).ndim))
    sizes = (*eqn.params["slice_sizes"], x.shape[-1])
    return bind(eqn, x, indices, dimension_numbers=numbers, slice_sizes=sizes)[0]


@rule("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max")
def _scatter(eqn: core.JaxprEqn, inputs: Sequence[Operand], size: int) -> list[Any] | None:
    x, indices, updates = inputs
    if indices.batched:
        return None
    numbers = eqn.params["dimension_numbers"]
    last = row_aval(eqn.invars[2]).ndim
    numbers = numbers._replace(update_window_dims=(*numbers.update_window_dims, last))
    into = spread(x, row_aval(eqn.invars[0]).shape, size)
    added = spread(updates, row_aval(eqn.invars[2]).shape, size)
    return bind(eqn, into, indices.value, added, dimension_numbers=numbers)


@rule("dot_general")
def _dot(eqn: core.JaxprEqn, inputs: Sequence[Operand], size: int) -> list[Any] | None:
    """Write a matrix product as sums of products of entries, without a library call."""
    if not _is_short(eqn):
        return None
    left, right = inputs
    contracted, batch = eqn.params["dimension_numbers"]
    out = row_aval(eqn.outvars[0])

    def arrange(side: int, operand: Operand) -> tuple[jax.Array, int]:
        """Order axes as contracted, batch, own, environments; return the number of own ones."""
        rank = row_aval(eqn.invars[side]).ndim
        own = [i for i in range(rank) if i not in contracted[side] and i not in batch[side]]
        axes = (*contracted[side], *batch[side], *own, *([rank] if operand.batched else []))
        return lax.transpose(operand.value.astype(out.dtype), axes), len(own)

    (x, x_own), (y, _) = arrange(0, left), arrange(1, right)
    lengths = x.shape[: len(contracted[0])]

    def multiply(a: jax.Array, b: jax.Array, leading: tuple[int, ...]) -> jax.Array:
        """Return (*leading, *out.shape, size) of axes leading, batch, own, and rows if batched."""
        shape = (*leading, *out.shape, size)
        shared = tuple(range(len(leading) + len(batch[0])))
        first, last = len(shared), len(shape) - 1
        a_axes = (*shared, *range(first, first + x_own), *([last] if left.batched else []))
        b_axes = (*shared, *range(first + x_own, last), *([last] if right.batched else []))
        return lax.broadcast_in_dim(a, shape, a_axes) * lax.broadcast_in_dim(b, shape, b_axes)

    if size <= FEW:
        return [jnp.sum(multiply(x, y, lengths), tuple(range(len(lengths))), dtype=out.dtype)]
    # Additions are vectorised over rows; a sum over an axis is not.
    terms = [multiply(x[index], y[index], ()) for index in itertools.product(*map(range, lengths))]
    return [sum(terms[1:], start=terms[0])]


def _is_short(eqn: core.JaxprEqn) -> bool:
    (contracted, _), _ = eqn.params["dimension_numbers"]
    terms = math.prod(row_aval(eqn.invars[0]).shape[axis] for axis in contracted)
    # Libraries accumulate products of short floats in longer ones.
    dtype = row_aval(eqn.outvars[0]).dtype
    is_short_float = jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize < 4
    return 0 < terms <= _LONGEST_SUM and not is_short_float
