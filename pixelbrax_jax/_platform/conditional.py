"""Results that XLA for CPUs computes in loops of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

_Result = TypeVar("_Result")


def in_a_conditional(compute: Callable[[], _Result]) -> _Result:
    """Return ``compute()``, which XLA for CPUs does not fuse into what reads it.

    It fuses across barriers but not across conditionals. The barrier hides from the compiler that
    the conditional is always taken; otherwise the compiler would remove it.
    """
    zero = jax.lax.optimization_barrier(jnp.int32(0))
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(compute))
    taken: _Result = jax.lax.cond(zero == 0, compute, lambda: blank)
    return taken
