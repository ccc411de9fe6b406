"""``jax.vmap`` with the batch as last axis of intermediate results, which is faster on a CPU."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from pixelbrax_jax._platform.by_platform import num_varying
from pixelbrax_jax._platform.programs import bind, interpret, row_aval, split_scan
from pixelbrax_jax._platform.rules import FEW, RULES, Operand, rule, spread

_LANES = 16
"""Rows are padded to a multiple, so that SIMD loops have no scalar remainder."""


def batch_last(fn: Callable[..., Any], in_axes: Sequence[int | None]) -> Callable[..., Any]:
    """Return ``jax.vmap(fn, in_axes)``, axes 0 or None, computed with the batch as last axis.

    ``jax.vmap`` puts it first, and XLA's innermost loops then run over vectors of three; here they
    run over environments. Results differ by rounding. ``jax.vmap`` computes what has no rule, such
    as functions with custom derivatives, and everything within a ``jax.shard_map`` that tracks
    varying values. More than a few rows are padded by copies of the last one, including side
    effects.

    The rules read private parameters of JAX's primitives. If a release changes them, ``jax.vmap``
    computes all of ``fn``, with a RuntimeWarning and side effects possibly twice.
    """

    def rows_of(*args: Any) -> Any:
        args = jax.tree.map(jnp.asarray, args)
        by_argument = [(x, axis is not None) for x, axis in zip(args, in_axes, strict=True)]
        leaves = [(x, batched) for arg, batched in by_argument for x in jax.tree.leaves(arg)]
        sizes = {len(x) for x, batched in leaves if batched}
        if len(sizes) != 1:
            raise ValueError(f"arguments must have the same number of rows, got {sorted(sizes)}.")
        if any(num_varying(jax.typeof(x)) for x, _ in leaves):
            return jax.vmap(fn, in_axes=tuple(in_axes))(*args)
        (size,) = sizes
        padded = size if size <= FEW else -(-size // _LANES) * _LANES
        row = [jax.tree.map(_row if batched else jax.typeof, arg) for arg, batched in by_argument]
        closed, shapes = jax.make_jaxpr(fn, return_shape=True)(*row)
        operands = [
            Operand(jnp.moveaxis(_pad_rows(x, padded), 0, -1) if batched else x, batched)
            for x, batched in leaves
        ]
        try:
            results = _evaluate(closed, operands, padded)
        # An unknown release of JAX must not fail; `make_jaxpr` above raised the user's own errors.
        except Exception as error:
            warnings.warn(
                f"jax {jax.__version__} has programs that PixelBrax cannot compute with the "
                f"environments as last axis ({type(error).__name__}: {error}). They are computed "
                "by jax.vmap: the results are as good, and on a CPU physics take up to three times "
                "as long.",
                RuntimeWarning,
                stacklevel=1,  # one line, so that Python warns once
            )
            return jax.vmap(fn, in_axes=tuple(in_axes))(*args)
        outputs, tree = jax.tree.flatten(shapes)
        rows = [spread(x, out.shape, padded) for x, out in zip(results, outputs, strict=True)]
        return jax.tree.unflatten(tree, [jnp.moveaxis(x, -1, 0)[:size] for x in rows])

    return rows_of


def _row(x: jax.Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape[1:], x.dtype, weak_type=jax.typeof(x).weak_type)


def _pad_rows(x: jax.Array, size: int) -> jax.Array:
    return x if len(x) == size else x[jnp.minimum(jnp.arange(size), len(x) - 1)]


def _evaluate(closed: core.ClosedJaxpr, operands: Sequence[Operand], size: int) -> list[Operand]:
    def of_constant(x: Any) -> Operand:
        return Operand(jnp.asarray(x) if isinstance(x, np.generic) else x, False)

    return interpret(closed, operands, partial(_apply, size=size), of_constant)


def _apply(eqn: core.JaxprEqn, inputs: list[Operand], size: int) -> list[Operand]:
    name = eqn.primitive.name
    if not any(x.batched for x in inputs):
        return [Operand(x, False) for x in bind(eqn, *(x.value for x in inputs))]
    if (program := _program(eqn)) is not None:
        return _evaluate(program, inputs[len(inputs) - len(program.jaxpr.invars) :], size)
    if name == "scan":
        return _scan(eqn, inputs, size)
    if name == "while":
        return _while(eqn, inputs, size)
    outputs = RULES[name](eqn, inputs, size) if name in RULES else None
    if outputs is None:
        outputs = _by_vmap(eqn, inputs)
    for x, var in zip(outputs, eqn.outvars, strict=True):
        if x.shape != (*row_aval(var).shape, size):
            raise ValueError(f"{name} gave {x.shape} for {row_aval(var).shape} of {size} rows.")
    return [Operand(x, True) for x in outputs]


def _by_vmap(eqn: core.JaxprEqn, inputs: list[Operand]) -> list[Any]:
    in_axes = [-1 if x.batched else None for x in inputs]
    rows = jax.vmap(lambda *row: bind(eqn, *row), in_axes=in_axes, out_axes=-1)
    return list(rows(*(x.value for x in inputs)))


_CALLS = {"jit": "jaxpr", "closed_call": "call_jaxpr"}
"""Primitives that contain a program, and the name of its parameter."""


def _program(eqn: core.JaxprEqn) -> core.ClosedJaxpr | None:
    """Return an equation's program to inline; for ``platform_dependent`` the CPU's."""
    if eqn.primitive.name in _CALLS:
        return eqn.params[_CALLS[eqn.primitive.name]]
    for platforms, branch in zip(
        eqn.params.get("branches_platforms") or (), eqn.params.get("branches", ()), strict=False
    ):
        if platforms is None or "cpu" in platforms:
            return branch
    return None


@rule("cond")
def _cond(eqn: core.JaxprEqn, inputs: Sequence[Operand], size: int) -> list[Any]:
    index, *operands = inputs
    flags = [x.batched for x in operands]
    shapes = [row_aval(var).shape for var in eqn.outvars]

    def branch(closed: core.ClosedJaxpr, *values: jax.Array) -> list[jax.Array]:
        results = _evaluate(closed, list(map(Operand, values, flags)), size)
        return [spread(x, shape, size) for x, shape in zip(results, shapes, strict=True)]

    branches = [partial(branch, closed) for closed in eqn.params["branches"]]
    values = [x.value for x in operands]
    if not index.batched:
        return list(lax.switch(index.value, branches, *values))
    # Rows take different branches: all branches are computed, as under `jax.vmap`.
    chosen = Operand(lax.clamp(0, index.value, len(branches) - 1), True)
    cases = zip(shapes, *(take(*values) for take in branches), strict=True)
    return [lax.select_n(spread(chosen, shape, size), *case) for shape, *case in cases]


def _scan(eqn: core.JaxprEqn, inputs: list[Operand], size: int) -> list[Operand]:
    closed, params = eqn.params["jaxpr"], eqn.params
    consts, first, xs = split_scan(params, inputs)
    num_carry, reached = len(first), _reach_scan(eqn, [x.batched for x in inputs])
    flags = reached[:num_carry]

    def carry(operands: Sequence[Operand]) -> list[Any]:
        shapes = [row_aval(var).shape for var in closed.jaxpr.outvars[:num_carry]]
        return _spread_where(operands, shapes, flags, size)

    def turn(carried: list[Any], slices: list[Any]) -> tuple[list[Any], list[Any]]:
        x_flags = [x.batched for x in xs]
        operands = [*consts, *map(Operand, carried, flags), *map(Operand, slices, x_flags)]
        results = _evaluate(closed, operands, size)
        return carry(results[:num_carry]), [y.value for y in results[num_carry:]]

    options = {name: params[name] for name in ("length", "reverse", "unroll")}
    last, ys = lax.scan(turn, carry(first), [x.value for x in xs], **options)
    return list(map(Operand, [*last, *ys], reached))


def _while(eqn: core.JaxprEqn, inputs: list[Operand], size: int) -> list[Operand]:
    """Loop until all rows have ended; rows that have ended keep their values."""
    params = eqn.params
    cond, body = params["cond_jaxpr"], params["body_jaxpr"]
    start, stop = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    cond_consts, body_consts, first = inputs[:start], inputs[start:stop], inputs[stop:]
    flags = _reach_while(eqn, [x.batched for x in inputs])
    shapes = [row_aval(var).shape for var in eqn.outvars]

    def unfinished(carried: list[Any]) -> Operand:
        return _evaluate(cond, [*cond_consts, *map(Operand, carried, flags)], size)[0]

    def turn(carried: list[Any]) -> list[Any]:
        results = _evaluate(body, [*body_consts, *map(Operand, carried, flags)], size)
        after = _spread_where(results, shapes, flags, size)
        going = unfinished(carried)
        if not going.batched:
            return after
        return [jnp.where(going.value, x, before) for x, before in zip(after, carried, strict=True)]

    carry = _spread_where(first, shapes, flags, size)
    last = lax.while_loop(lambda carried: jnp.any(unfinished(carried).value), turn, carry)
    return list(map(Operand, last, flags))


def _reach_while(eqn: core.JaxprEqn, flags: list[bool]) -> list[bool]:
    """Return which carries of a loop are batched: all of them if rows end at different times."""
    params = eqn.params
    start, stop = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    carried, before = flags[stop:], None
    while carried != before:
        before = carried
        reached = _reach(params["body_jaxpr"], [*flags[start:stop], *carried])
        if any(_reach(params["cond_jaxpr"], [*flags[:start], *carried])):
            reached = [True] * len(carried)
        carried = [a or b for a, b in zip(carried, reached, strict=True)]
    return carried


def _spread_where(
    operands: Sequence[Operand], shapes: Sequence[tuple[int, ...]], flags: Sequence[bool], size: int
) -> list[Any]:
    return [
        spread(x, shape, size) if flag else x.value
        for x, shape, flag in zip(operands, shapes, flags, strict=True)
    ]


def _reach_scan(eqn: core.JaxprEqn, flags: list[bool]) -> list[bool]:
    consts, carried, xs = split_scan(eqn.params, flags)
    # A carry that becomes batched may make others batched in the next iteration.
    before = None
    while carried != before:
        before = carried
        reached = _reach(eqn.params["jaxpr"], [*consts, *carried, *xs])
        carried = [a or b for a, b in zip(carried, reached, strict=False)]
    return [*carried, *reached[len(carried) :]]


def _reach(closed: core.ClosedJaxpr, flags: Sequence[bool]) -> list[bool]:
    """Return which results of a program are batched, as in `_evaluate`."""

    def apply(eqn: core.JaxprEqn, inputs: list[bool]) -> list[bool]:
        if (program := _program(eqn)) is not None:
            return _reach(program, inputs[len(inputs) - len(program.jaxpr.invars) :])
        if eqn.primitive.name == "scan":
            return _reach_scan(eqn, inputs)
        if eqn.primitive.name == "while":
            return _reach_while(eqn, inputs)
        return [any(inputs)] * len(eqn.outvars)

    return interpret(closed, flags, apply, lambda _: False)
