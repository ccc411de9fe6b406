"""The flags of JAX under which programs are traced, whatever a process has set."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

_P = ParamSpec("_P")
_T = TypeVar("_T")

PRNG = "threefry2x32"
"""The implementation of all random numbers: the one of JAX's own in which a key's numbers do not
depend on the other keys of a batch."""

_FLAGS = (
    partial(jax.enable_x64, False),
    partial(jax.numpy_dtype_promotion, "standard"),
    partial(jax.numpy_rank_promotion, "allow"),
    partial(jax.default_prng_impl, PRNG),
    partial(jax.threefry_partitionable, True),
    partial(jax.check_tracer_leaks, False),
    partial(jax.debug_infs, False),
    partial(jax.transfer_guard, "allow"),
)
"""Those that change what a program computes, or which programs JAX accepts, at JAX's defaults. The
last three check what is within: jaxopt, which Brax steps with, leaks tracers, limits of joints are
infinite, and models are made of Python's numbers. What a compiled program takes and returns is
checked as a process has set it."""

_SHORT = {
    np.dtype(long): np.dtype(short)
    for long, short in (
        ("float64", "float32"),
        ("int64", "int32"),
        ("uint64", "uint32"),
        ("complex128", "complex64"),
    )
}


@contextmanager
def default_flags() -> Iterator[None]:
    """Trace what is within as JAX does by default.

    Brax, MuJoCo XLA, flax and optax are written for JAX's defaults, and so is this package: with
    ``jax_enable_x64`` or strict promotion some of their programs are others, or none. How precisely
    an accelerator multiplies matrices stays as it is set.
    """
    with ExitStack() as flags:
        for flag in _FLAGS:
            flags.enter_context(flag())
        yield


def under_default_flags(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorate a function that is traced, so that it is traced under ``default_flags``.

    Within ``jax.jit``, so that a compiled program's call costs nothing. Arguments of 64 bits are
    rounded to 32, and keys of another implementation than threefry become keys of it: those of
    JAX's ``rbg`` and ``unsafe_rbg`` that equal seeds make become equal ones.
    """

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with default_flags():
            args, kwargs = jax.tree.map(as_by_default, (args, kwargs))
            return function(*args, **kwargs)

    return call


def is_guarded(direction: str) -> bool:
    """Return whether ``jax.transfer_guard`` watches ``host_to_device`` or ``device_to_host``."""
    return getattr(jax.config, f"jax_transfer_guard_{direction}", None) is not None


def as_by_default(leaf: Any) -> Any:
    """Return an array of 32 bits, or keys of threefry; anything else as it is."""
    dtype = getattr(leaf, "dtype", None)
    if dtype is None:
        return leaf
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        if jax.random.key_impl(leaf) == PRNG:
            return leaf
        # The others of JAX keep a threefry key twice.
        return jax.random.wrap_key_data(jax.random.key_data(leaf)[..., :2], impl=PRNG)
    return leaf.astype(_SHORT[dtype]) if dtype in _SHORT else leaf
