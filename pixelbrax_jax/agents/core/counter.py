"""A count of steps that does not overflow."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

_WORD = 2**32


class StepCounter(struct.PyTreeNode):
    """A whole number in [0, 2^64) that counts inside compiled programs.

    JAX's integers have 32 bits unless 64 are enabled for everything; a run of a few thousand
    million steps is longer than that. Here are two words of 32 bits, with the carry by hand.
    Beyond 2^64 - 1 it starts again at 0.

    Attributes:
        high: () uint32, multiples of 2^32.
        low: () uint32, the rest.
    """

    high: jax.Array
    low: jax.Array

    @classmethod
    def of(cls, value: int) -> StepCounter:
        """Return the counter that stands at ``value``.

        Raises:
            TypeError: the value is no whole number.
            ValueError: it is not in [0, 2^64).
        """
        if not isinstance(value, Integral) or isinstance(value, bool):
            raise TypeError(f"a counter counts whole numbers, got {value!r}.")
        if not 0 <= value < _WORD**2:
            raise ValueError(f"a counter holds numbers in [0, 2**64), got {value}.")
        high, low = divmod(int(value), _WORD)
        return cls(high=jnp.uint32(high), low=jnp.uint32(low))

    def __add__(self, other: StepCounter | int | jax.Array) -> StepCounter:
        """Return the sum, also inside ``jit``.

        Args:
            other: a counter, a whole number in [0, 2^64), or a () uint32 array.

        Raises:
            TypeError: it is an array of another dtype, or no number at all.
            ValueError: it is negative or too large.
        """
        other = _counter(other)
        low = self.low + other.low
        carry = (low < other.low).astype(jnp.uint32)
        return StepCounter(high=self.high + other.high + carry, low=low)

    __radd__ = __add__

    def __int__(self) -> int:
        """Return the number; outside ``jit``, and of a single counter."""
        return int(np.asarray(self.high)) * _WORD + int(np.asarray(self.low))

    def as_float(self) -> jax.Array:
        """Return the number as () float32, exact up to 2^24 and to 1 part in 10^7 beyond."""
        return self.high.astype(jnp.float32) * float(_WORD) + self.low.astype(jnp.float32)


def _counter(value: Any) -> StepCounter:
    if isinstance(value, StepCounter):
        return value
    if isinstance(value, jax.Array):
        if value.dtype != jnp.uint32:
            raise TypeError(f"a counter adds arrays of dtype uint32, got {value.dtype}.")
        return StepCounter(high=jnp.zeros_like(value), low=value)
    return StepCounter.of(value)
