"""Read JAX's programs, equation by equation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jax.extend import core

_T = TypeVar("_T")


def interpret(
    closed: core.ClosedJaxpr,
    operands: Sequence[_T],
    apply: Callable[[core.JaxprEqn, list[_T]], Sequence[_T]],
    of_constant: Callable[[Any], _T],
) -> list[_T]:
    """Return the results of a program; ``apply(eqn, inputs)`` returns those of an equation.

    ``of_constant`` maps constants, and literals (NumPy scalars), to inputs of ``apply``.
    """
    jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.constvars, map(of_constant, closed.consts), strict=True))
    known.update(zip(jaxpr.invars, operands, strict=True))

    def read(atom: core.Var | core.Literal) -> _T:
        if isinstance(atom, core.Literal):
            return of_constant(np.asarray(atom.val, row_aval(atom).dtype)[()])
        return known[atom]

    for eqn in jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        with eqn.ctx.manager:
            known.update(zip(eqn.outvars, apply(eqn, inputs), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def row_aval(atom: core.Var | core.Literal) -> Any:
    """Return shape and dtype of one row."""
    return atom.aval


def bind(eqn: core.JaxprEqn, *values: Any, **changed: Any) -> list[Any]:
    """Compute an equation's primitive for other values, with some parameters changed."""
    params = eqn.primitive.get_bind_params({**eqn.params, **changed})
    outputs = eqn.primitive.bind(*values, **params)
    return list(outputs) if eqn.primitive.multiple_results else [outputs]


def split_scan(
    params: Mapping[str, Any], operands: list[_T]
) -> tuple[list[_T], list[_T], list[_T]]:
    """Split a scan's operands into constants, carry and sliced arrays."""
    if "num_carry" in params:
        start, num_carry = params["num_consts"], params["num_carry"]
    else:  # from jax 0.12 on
        start, num_carry, _ = map(len, params["ft_in"].unpack())
    stop = start + num_carry
    return operands[:start], operands[start:stop], operands[stop:]
