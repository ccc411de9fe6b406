"""``jax.vmap`` with the batch as last axis of intermediate results, which is what a CPU wants.

``jax.vmap`` puts the batch first. What Brax computes are vectors of three and matrices of three by
three, so that XLA's innermost loops over (N, links, 3) have three turns, no vectors, and a product
of matrices is a call for every link. Over (links, 3, N) they are loops over environments.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core

_LANES = 16
"""Rows are padded to a multiple, so that loops over vectors leave no scalar remainder."""

_FEW = 4
"""So many rows are not padded, and their products of matrices not written out: loops over so few
gain nothing."""

_LONGEST_SUM = 16
"""Products of matrices over longer axes stay calls of a library."""


class _Operand(NamedTuple):
    """A value for every row, with the batch as last axis, or one for all rows."""

    value: Any
    batched: bool


def batch_last(fn: Callable[..., Any], in_axes: Sequence[int | None]) -> Callable[..., Any]:
    """``jax.vmap(fn, in_axes)``, computed with the batch as last axis.

    Results differ from those of ``jax.vmap`` by rounding. What has no rule here, among it loops
    that end by themselves and functions with derivatives of their own, is computed by
    ``jax.vmap``, as is everything within ``jax.shard_map`` if that keeps track of what varies.
    More than a few rows are padded by copies of the last one, whose side effects happen too.

    The parameters of JAX's primitives, which are read here, are not public. With a release whose
    parameters are others, all of ``fn`` is computed by ``jax.vmap``, with a RuntimeWarning once in
    a process. Side effects, such as those of ``jax.debug.print``, may happen twice then.

    Args:
        fn: a function of trees of arrays, of one row.
        in_axes: for each argument 0, a row in each entry of its arrays' first axis, or None, the
            same for all rows. At least one is 0.

    Returns:
        The function of all rows; its results have rows along their first axis. It raises a
        ValueError if arguments have different numbers of rows.
    """

    def rows_of(*args: Any) -> Any:
        args = jax.tree.map(jnp.asarray, args)
        by_argument = [(x, axis is not None) for x, axis in zip(args, in_axes, strict=True)]
        leaves = [(x, batched) for arg, batched in by_argument for x in jax.tree.leaves(arg)]
        sizes = {len(x) for x, batched in leaves if batched}
        if len(sizes) != 1:
            raise ValueError(f"arguments must have the same number of rows, got {sorted(sizes)}.")
        if any(_varies(x) for x, _ in leaves):
            return jax.vmap(fn, in_axes=tuple(in_axes))(*args)
        (size,) = sizes
        padded = size if size <= _FEW else -(-size // _LANES) * _LANES
        row = [jax.tree.map(_row if batched else jax.typeof, arg) for arg, batched in by_argument]
        closed, shapes = jax.make_jaxpr(fn, return_shape=True)(*row)
        operands = [
            _Operand(jnp.moveaxis(_pad_rows(x, padded), 0, -1) if batched else x, batched)
            for x, batched in leaves
        ]
        try:
            results = _evaluate(closed, operands, padded)
        # Whatever this meets in an unknown release must not stop a user: `fn` itself, and so the
        # user's mistakes, went through `make_jaxpr` above.
        except Exception as error:
            _warn_once(error)
            return jax.vmap(fn, in_axes=tuple(in_axes))(*args)
        outputs, tree = jax.tree.flatten(shapes)
        spread = [_spread(x, out.shape, padded) for x, out in zip(results, outputs, strict=True)]
        return jax.tree.unflatten(tree, [jnp.moveaxis(x, -1, 0)[:size] for x in spread])

    return rows_of


_warned: list[str] = []
"""Warnings given in this process: one at most."""


def _warn_once(error: Exception) -> None:
    if _warned:
        return
    _warned.append(
        f"jax {jax.__version__} has programs that PixelBrax cannot compute with the environments "
        f"as last axis ({type(error).__name__}: {error}). They are computed by jax.vmap: the "
        "results are as good, and on a CPU physics take up to three times as long."
    )
    warnings.warn(_warned[0], RuntimeWarning, stacklevel=3)


def _varies(x: jax.Array) -> bool:
    """Whether ``jax.shard_map`` tracks that devices have different values of ``x``."""
    return bool(getattr(getattr(jax.typeof(x), "manual_axis_type", None), "varying", ()))


def _aval(atom: core.Var | core.Literal) -> Any:
    """Shape and dtype of one row, which JAX types as anything abstract."""
    return atom.aval


def _row(x: jax.Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape[1:], x.dtype, weak_type=jax.typeof(x).weak_type)


def _pad_rows(x: jax.Array, size: int) -> jax.Array:
    """Rows, and the last one again until there are ``size``."""
    return x if len(x) == size else x[jnp.minimum(jnp.arange(size), len(x) - 1)]


def _evaluate(closed: core.ClosedJaxpr, operands: Sequence[_Operand], size: int) -> list[_Operand]:
    """Results of a program, equation by equation."""
    known: dict[core.Var, _Operand] = {}

    def read(atom: core.Var | core.Literal) -> _Operand:
        if isinstance(atom, core.Literal):
            return _Operand(jnp.asarray(atom.val, _aval(atom).dtype), False)
        return known[atom]

    jaxpr = closed.jaxpr
    known.update(zip(jaxpr.constvars, (_Operand(x, False) for x in closed.consts), strict=True))
    known.update(zip(jaxpr.invars, operands, strict=True))
    for eqn in jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        with eqn.ctx.manager:
            known.update(zip(eqn.outvars, _apply(eqn, inputs, size), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(eqn: core.JaxprEqn, inputs: list[_Operand], size: int) -> list[_Operand]:
    name = eqn.primitive.name
    values = [x.value for x in inputs]
    flags = [x.batched for x in inputs]
    if not any(flags):
        return [_Operand(x, False) for x in _bind(eqn, *values)]
    if name in _CALLS:
        return _evaluate(eqn.params[_CALLS[name]], inputs, size)
    if name == "scan":
        return _scan(eqn, inputs, size)
    if name in _ELEMENTWISE:
        shape = _aval(eqn.outvars[0]).shape
        outputs = _bind(eqn, *(_spread(x, shape, size) for x in inputs))
    elif name in _NAMED_AXES:
        outputs = _bind(eqn, *values)
    elif name in _FIRST_BATCHED and flags == [True] + [False] * (len(flags) - 1):
        outputs = [_FIRST_BATCHED[name](eqn, *values)]
    elif name in ("concatenate", "stack"):
        parts = [
            _spread(x, _aval(atom).shape, size) for x, atom in zip(inputs, eqn.invars, strict=True)
        ]
        # A barrier: else XLA reads the parts in place of slices of the whole, and computes them
        # anew in each kernel that reads one.
        outputs = lax.optimization_barrier(_bind(eqn, *parts))
    elif name == "dot_general" and _is_short(eqn):
        outputs = [_dot(eqn, size, *inputs)]
    elif name in _SCATTERS and not flags[1]:
        outputs = [_scatter(eqn, size, *inputs)]
    elif name == "cond":
        outputs = _cond(eqn, size, inputs[0], inputs[1:])
    else:
        in_axes = [-1 if batched else None for batched in flags]
        outputs = jax.vmap(lambda *row: _bind(eqn, *row), in_axes=in_axes, out_axes=-1)(*values)
    for x, var in zip(outputs, eqn.outvars, strict=True):
        if x.shape != (*_aval(var).shape, size):
            raise ValueError(f"{name} gave {x.shape} for {_aval(var).shape} of {size} rows.")
    return [_Operand(x, True) for x in outputs]


def _bind(eqn: core.JaxprEqn, *values: Any, **changed: Any) -> list[Any]:
    params = eqn.primitive.get_bind_params({**eqn.params, **changed})
    # Other releases of JAX hand out functions apart.
    functions, params = params if isinstance(params, tuple) else ((), params)
    outputs = eqn.primitive.bind(*functions, *values, **params)
    return list(outputs) if eqn.primitive.multiple_results else [outputs]


def _spread(operand: _Operand, shape: tuple[int, ...], size: int) -> jax.Array:
    """The operand as (*shape, size); its row has ``shape`` or is a scalar."""
    rank = jnp.ndim(operand.value) - operand.batched
    axes = tuple(range(rank)) + ((len(shape),) if operand.batched else ())
    if operand.batched and rank == len(shape):
        return operand.value
    return lax.broadcast_in_dim(operand.value, (*shape, size), axes)


_CALLS = {"jit": "jaxpr", "closed_call": "call_jaxpr"}
"""Primitives that are programs, which are written out in place, and the parameter that has it."""

_ELEMENTWISE_NAMES = """
abs acos add and asin atan atan2 cbrt ceil clamp convert_element_type copy copy_p cos cosh div eq
erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg
nextafter not or pow reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic
shift_right_logical sign sin sinh sqrt square sub tan tanh xor
"""
_ELEMENTWISE = frozenset(_ELEMENTWISE_NAMES.split())

_NAMED_AXES_NAMES = """
argmax argmin cumlogsumexp cummax cummin cumprod cumsum reduce_and reduce_max reduce_min reduce_or
reduce_prod reduce_sum rev split squeeze
"""
_NAMED_AXES = frozenset(_NAMED_AXES_NAMES.split())
"""Primitives whose parameters name the axes they work on: one more at the end changes nothing."""


def _broadcast(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    shape = eqn.params["shape"]
    axes = (*eqn.params["broadcast_dimensions"], len(shape))
    return lax.broadcast_in_dim(x, (*shape, x.shape[-1]), axes)


def _reshape(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    order = eqn.params["dimensions"]
    order = None if order is None else (*order, x.ndim - 1)
    return lax.reshape(x, (*eqn.params["new_sizes"], x.shape[-1]), order)


def _transpose(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    return lax.transpose(x, (*eqn.params["permutation"], x.ndim - 1))


def _tile(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    return lax.tile(x, (*eqn.params["reps"], 1))


def _slice(eqn: core.JaxprEqn, x: jax.Array) -> jax.Array:
    strides = eqn.params["strides"] or (1,) * (x.ndim - 1)
    start, limit = eqn.params["start_indices"], eqn.params["limit_indices"]
    return lax.slice(x, (*start, 0), (*limit, x.shape[-1]), (*strides, 1))


def _dynamic_slice(eqn: core.JaxprEqn, x: jax.Array, *start: jax.Array) -> jax.Array:
    # Bound as it is: `lax.dynamic_slice` would take negative indices from the end once more.
    zero = jnp.zeros((), start[0].dtype if start else jnp.int32)
    sizes = (*eqn.params["slice_sizes"], x.shape[-1])
    return _bind(eqn, x, *start, zero, slice_sizes=sizes)[0]


def _pad(eqn: core.JaxprEqn, x: jax.Array, padding: jax.Array) -> jax.Array:
    return lax.pad(x, padding, (*eqn.params["padding_config"], (0, 0, 0)))


def _gather(eqn: core.JaxprEqn, x: jax.Array, indices: jax.Array) -> jax.Array:
    numbers = eqn.params["dimension_numbers"]
    numbers = numbers._replace(offset_dims=(*numbers.offset_dims, _aval(eqn.outvars[0]).ndim))
    sizes = (*eqn.params["slice_sizes"], x.shape[-1])
    return _bind(eqn, x, indices, dimension_numbers=numbers, slice_sizes=sizes)[0]


_FIRST_BATCHED: dict[str, Callable[..., jax.Array]] = {
    "broadcast_in_dim": _broadcast,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "pad": _pad,
    "reshape": _reshape,
    "slice": _slice,
    "tile": _tile,
    "transpose": _transpose,
}
"""Rules for a batched first operand and further ones that are the same for all rows."""


_SCATTERS = frozenset(["scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max"])


def _scatter(
    eqn: core.JaxprEqn, size: int, x: _Operand, indices: _Operand, updates: _Operand
) -> jax.Array:
    numbers = eqn.params["dimension_numbers"]
    last = _aval(eqn.invars[2]).ndim
    numbers = numbers._replace(update_window_dims=(*numbers.update_window_dims, last))
    into = _spread(x, _aval(eqn.invars[0]).shape, size)
    added = _spread(updates, _aval(eqn.invars[2]).shape, size)
    return _bind(eqn, into, indices.value, added, dimension_numbers=numbers)[0]


def _is_short(eqn: core.JaxprEqn) -> bool:
    (contracted, _), _ = eqn.params["dimension_numbers"]
    terms = 1
    for axis in contracted:
        terms *= _aval(eqn.invars[0]).shape[axis]
    # Libraries add the products of short floats in longer ones.
    dtype = _aval(eqn.outvars[0]).dtype
    is_short_float = jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize < 4
    return 0 < terms <= _LONGEST_SUM and not is_short_float


def _dot(eqn: core.JaxprEqn, size: int, left: _Operand, right: _Operand) -> jax.Array:
    """A product of matrices as sums of products of entries: no call of a library."""
    contracted, batch = eqn.params["dimension_numbers"]
    out = _aval(eqn.outvars[0])

    def arrange(side: int, operand: _Operand) -> tuple[jax.Array, int]:
        """With axes contracted, batch, own, and the environments'; and how many are own."""
        rank = _aval(eqn.invars[side]).ndim
        own = [i for i in range(rank) if i not in contracted[side] and i not in batch[side]]
        axes = (*contracted[side], *batch[side], *own, *([rank] if operand.batched else []))
        return lax.transpose(operand.value.astype(out.dtype), axes), len(own)

    (x, x_own), (y, _) = arrange(0, left), arrange(1, right)
    lengths = x.shape[: len(contracted[0])]

    def multiply(a: jax.Array, b: jax.Array, leading: tuple[int, ...]) -> jax.Array:
        """Products of entries, (*leading, *out.shape, size).

        Axes of ``a`` and ``b`` are leading, batch, own, and rows if batched.
        """
        shape = (*leading, *out.shape, size)
        shared = tuple(range(len(leading) + len(batch[0])))
        first, last = len(shared), len(shape) - 1
        a_axes = (*shared, *range(first, first + x_own), *([last] if left.batched else []))
        b_axes = (*shared, *range(first + x_own, last), *([last] if right.batched else []))
        return lax.broadcast_in_dim(a, shape, a_axes) * lax.broadcast_in_dim(b, shape, b_axes)

    if size <= _FEW:
        return jnp.sum(multiply(x, y, lengths), tuple(range(len(lengths))), dtype=out.dtype)
    # Additions run over many rows at a time, which a sum over an axis was seen not to.
    terms = [multiply(x[index], y[index], ()) for index in itertools.product(*map(range, lengths))]
    return sum(terms[1:], start=terms[0])


def _cond(
    eqn: core.JaxprEqn, size: int, index: _Operand, operands: list[_Operand]
) -> list[jax.Array]:
    flags = [x.batched for x in operands]
    shapes = [_aval(var).shape for var in eqn.outvars]

    def branch(closed: core.ClosedJaxpr, *values: jax.Array) -> list[jax.Array]:
        results = _evaluate(closed, list(map(_Operand, values, flags)), size)
        return [_spread(x, shape, size) for x, shape in zip(results, shapes, strict=True)]

    branches = [partial(branch, closed) for closed in eqn.params["branches"]]
    values = [x.value for x in operands]
    if not index.batched:
        return list(lax.switch(index.value, branches, *values))
    # Rows differ in their branch: all are computed, as under `jax.vmap`.
    chosen = _Operand(lax.clamp(0, index.value, len(branches) - 1), True)
    cases = zip(shapes, *(take(*values) for take in branches), strict=True)
    return [lax.select_n(_spread(chosen, shape, size), *case) for shape, *case in cases]


def _scan(eqn: core.JaxprEqn, inputs: list[_Operand], size: int) -> list[_Operand]:
    closed, params = eqn.params["jaxpr"], eqn.params
    num_consts, num_carry = _scan_sizes(params)
    consts, first = inputs[:num_consts], inputs[num_consts : num_consts + num_carry]
    xs = inputs[num_consts + num_carry :]
    reached = _reach_scan(eqn, [x.batched for x in inputs])
    flags = reached[:num_carry]

    def carry(operands: Sequence[_Operand]) -> list[Any]:
        shapes = [_aval(var).shape for var in closed.jaxpr.outvars[:num_carry]]
        return [
            _spread(x, shape, size) if flag else x.value
            for x, shape, flag in zip(operands, shapes, flags, strict=True)
        ]

    def turn(carried: list[Any], slices: list[Any]) -> tuple[list[Any], list[Any]]:
        x_flags = [x.batched for x in xs]
        operands = [*consts, *map(_Operand, carried, flags), *map(_Operand, slices, x_flags)]
        results = _evaluate(closed, operands, size)
        return carry(results[:num_carry]), [y.value for y in results[num_carry:]]

    options = {name: params[name] for name in ("length", "reverse", "unroll")}
    last, ys = lax.scan(turn, carry(first), [x.value for x in xs], **options)
    return list(map(_Operand, [*last, *ys], reached))


def _scan_sizes(params: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many of a scan's operands are constants, and how many are carried."""
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    # From jax 0.12 on: operands in groups.
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(carry)


def _reach_scan(eqn: core.JaxprEqn, flags: list[bool]) -> list[bool]:
    """Which carries and results of a scan are batched."""
    start, num_carry = _scan_sizes(eqn.params)
    stop = start + num_carry
    # What reaches a carry in one turn reaches others in the next.
    carried, before = flags[start:stop], None
    while carried != before:
        before = carried
        reached = _reach(eqn.params["jaxpr"], [*flags[:start], *carried, *flags[stop:]])
        carried = [a or b for a, b in zip(carried, reached, strict=False)]
    return [*carried, *reached[len(carried) :]]


def _reach(closed: core.ClosedJaxpr, flags: Sequence[bool]) -> list[bool]:
    """Which results of a program are batched, as `_evaluate` finds."""
    known = dict(zip(closed.jaxpr.invars, flags, strict=True))

    def read(atom: core.Var | core.Literal) -> bool:
        return not isinstance(atom, core.Literal) and known.get(atom, False)

    for eqn in closed.jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        if eqn.primitive.name in _CALLS:
            outputs = _reach(eqn.params[_CALLS[eqn.primitive.name]], inputs)
        elif eqn.primitive.name == "scan":
            outputs = _reach_scan(eqn, inputs)
        else:
            outputs = [any(inputs)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, outputs, strict=True))
    return [read(atom) for atom in closed.jaxpr.outvars]
