"""Results that XLA for CPUs computes in loops of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

_Result = TypeVar("_Result")


def in_a_conditional(compute: Callable[[jax.Array], _Result], like: Any) -> _Result:
    """Return ``compute(zero)``, which XLA for CPUs does not fuse into what reads it.

    It fuses across barriers but not across conditionals. ``zero`` is () int32 behind a barrier,
    which hides from the compiler that the conditional is always taken; otherwise the compiler would
    remove it. ``like`` has the shapes and dtypes of the result.
    """
    zero = jax.lax.optimization_barrier(jnp.int32(0))
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    # JAX batches a branch twice under ``jax.vmap``, and a program of ``jax.jit`` once.
    return jax.lax.cond(zero == 0, lambda: jax.jit(compute)(zero), lambda: blank)
