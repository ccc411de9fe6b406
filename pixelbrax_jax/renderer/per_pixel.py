"""Detection of pixelwise changes of an image, which a kernel applies when it renders a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from pixelbrax_jax._platform.programs import bind, interpret, row_aval
from pixelbrax_jax.types import Frame

_ELEMENTWISE_NAMES = """
abs add and ceil clamp convert_element_type cos copy copy_p div eq exp exp2 floor ge gt integer_pow
is_finite le log log1p logistic lt max min mul ne neg not or pow rsqrt select_n shift_left
shift_right_arithmetic shift_right_logical sign sin sqrt square stop_gradient sub tanh xor
"""
"""Primitives of JAX that a kernel supports."""

_ELEMENTWISE = frozenset(_ELEMENTWISE_NAMES.split())

_DTYPES = ("float32", "int32", "uint32", "bool")


class _Pixel(NamedTuple):
    """A value per pixel, by its index: the frame's channels, then all results."""

    place: int


class _Given(NamedTuple):
    """A value that is computed before: ``inputs[group][place]``, or a constant."""

    group: str
    place: Any


class _NotPerPixelError(Exception):
    """A pixel of the result depends on other pixels."""


@dataclass
class PerPixel:
    """A pixelwise change of an image of ``shape`` (H, W).

    All pixels need the () ``numbers``, and each its own entry of the (H, W) ``images``.
    """

    shape: tuple[int, ...]
    num_planes: int
    numbers: list[jax.Array] = field(default_factory=list)
    images: list[jax.Array] = field(default_factory=list)
    _steps: list[tuple[core.JaxprEqn, list[_Pixel | _Given]]] = field(default_factory=list)
    # By the id of an array. The entry keeps the array, so that no other one gets its id.
    _scalars: dict[int, tuple[Any, Any]] = field(default_factory=dict)
    _equations: dict[int, tuple[Any, core.JaxprEqn, list[Any]]] = field(default_factory=dict)
    _found: dict[int, tuple[Any, _Pixel | _Given]] = field(default_factory=dict)

    def apply(self, frame: Frame, numbers: Sequence[Any], images: Sequence[Any]) -> jax.Array:
        """Return the result for some pixels of a frame, given the same pixels of the images."""
        known, given = jax.tree.leaves(frame), {"number": numbers, "image": images}

        def value(x: _Pixel | _Given) -> Any:
            if isinstance(x, _Pixel):
                return known[x.place]
            return x.place if x.group == "constant" else given[x.group][x.place]

        for eqn, operands in self._steps:
            known += bind(eqn, *(jnp.broadcast_to(value(x), frame.r.shape) for x in operands))
        return known[-1]

    def read(self, closed: core.ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
        """Read a program: compute what does not depend on pixels, and record the rest."""
        return interpret(closed, operands, self._read_equation, lambda x: x)

    def _read_equation(self, eqn: core.JaxprEqn, operands: list[Any]) -> list[Any]:
        if eqn.primitive.name == "jit":
            return self.read(eqn.params["jaxpr"], operands)
        if any(isinstance(x, _Pixel) for x in operands):
            return [self._add(eqn, operands)]
        if operands and all(isinstance(x, np.generic) for x in operands):
            with jax.ensure_compile_time_eval():
                results = bind(eqn, *operands)
            results = [np.asarray(x)[()] for x in results]
        else:
            results = bind(eqn, *operands)
        if eqn.primitive.name == "broadcast_in_dim" and jnp.ndim(operands[0]) == 0:
            self._scalars[id(results[0])] = (results[0], operands[0])
        elif self._is_elementwise(eqn):
            # A part of an image, such as its red channel: the kernel computes it if needed.
            self._equations[id(results[0])] = (results[0], eqn, operands)
        return results

    def _is_elementwise(self, eqn: core.JaxprEqn) -> bool:
        aval = row_aval(eqn.outvars[0])
        fits = aval.shape == self.shape and aval.dtype.name in _DTYPES
        return eqn.primitive.name in _ELEMENTWISE and fits

    def _add(self, eqn: core.JaxprEqn, operands: Sequence[Any]) -> _Pixel:
        if not self._is_elementwise(eqn):
            raise _NotPerPixelError
        self._steps.append((eqn, list(map(self._operand, operands))))
        return _Pixel(self.num_planes + len(self._steps) - 1)

    def _operand(self, x: Any) -> _Pixel | _Given:
        if isinstance(x, _Pixel):
            return x
        _, x = self._scalars.get(id(x), (x, x))
        if isinstance(x, np.generic):
            return _Given("constant", x)
        if id(x) not in self._found:
            self._found[id(x)] = (x, self._find(x))
        return self._found[id(x)][1]

    def _find(self, x: Any) -> _Pixel | _Given:
        if id(x) in self._equations:
            with suppress(_NotPerPixelError):  # then the image itself may be read
                return self._add(*self._equations[id(x)][1:])
        if x.dtype.name not in _DTYPES[:-1]:
            raise _NotPerPixelError
        group, array = ("image", self.images) if x.shape else ("number", self.numbers)
        array.append(jnp.broadcast_to(x, self.shape) if x.shape else x)
        return _Given(group, len(array) - 1)


def per_pixel(change: Callable[[Frame], jax.Array], frame: Frame) -> PerPixel | None:
    """Return a change of a frame into an array of its size; None if it is not pixelwise."""
    closed = jax.make_jaxpr(change)(frame)
    planes = [_Pixel(place) for place in range(len(closed.jaxpr.invars))]
    found = PerPixel(frame.r.shape, len(planes))
    try:
        (result,) = found.read(closed, planes)
    except _NotPerPixelError:
        return None
    last = len(planes) + len(found._steps) - 1
    return found if found._steps and result == _Pixel(last) else None
