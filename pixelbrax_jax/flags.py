"""JAX flags under which programs are traced, whatever flags the process has set."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

_P = ParamSpec("_P")
_T = TypeVar("_T")

PRNG = "threefry2x32"
"""Implementation of all random numbers: JAX's only one in which the numbers of a key do not depend
on the other keys of a batch."""

PRECISION = "highest"
"""Precision of matrix products in environments."""

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
"""Flags that change a program's result or what JAX accepts, at their defaults. The last three
checks must be off: jaxopt, used by Brax, leaks tracers, joint limits are infinite, and models
contain Python numbers. A program's inputs and outputs are checked as the process has set it."""


@contextmanager
def default_flags() -> Iterator[None]:
    """Trace programs in this block under JAX's default flags.

    Brax, MuJoCo XLA, flax, optax and this package need the defaults: ``jax_enable_x64`` or strict
    promotion would change or break some programs. The precision of matrix products on an
    accelerator stays as it is set, see ``under_environment_flags``.
    """
    with ExitStack() as flags:
        for flag in _FLAGS:
            flags.enter_context(flag())
        yield


def under_default_flags(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorate a function so that it is traced under ``default_flags``.

    Use it inside ``jax.jit``, so that calls of the compiled program cost nothing. 64-bit arguments
    are rounded to 32 bits, and keys of other implementations become threefry keys: ``rbg`` and
    ``unsafe_rbg`` keys of equal seeds become equal keys.
    """

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with default_flags():
            args, kwargs = jax.tree.map(as_by_default, (args, kwargs))
            return function(*args, **kwargs)

    return call


def under_environment_flags(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorate a function of physics or images like ``under_default_flags``.

    Matrix products have the highest precision. By default a GPU may round their factors to 10 bits
    and a TPU to 8, which moves silhouettes and centimetres of depth.
    """

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with jax.default_matmul_precision(PRECISION):
            return function(*args, **kwargs)

    return under_default_flags(call)


def is_key(dtype: Any) -> bool:
    """Return whether the dtype is one of typed PRNG keys."""
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)


def without_keys(leaf: jax.Array) -> jax.Array:
    """Return the uint32 words of typed keys; another array unchanged."""
    return jax.random.key_data(leaf) if is_key(leaf.dtype) else leaf


def with_keys(data: jax.Array, like: Any) -> jax.Array:
    """Invert ``without_keys`` for an array with the dtype of ``like``, whatever JAX's default."""
    if not is_key(like.dtype):
        return data
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(jnp.empty((), like.dtype)))


def is_guarded(direction: str) -> bool:
    """Return whether ``jax.transfer_guard`` watches ``host_to_device`` or ``device_to_host``."""
    return getattr(jax.config, f"jax_transfer_guard_{direction}", None) is not None


def as_by_default(leaf: Any) -> Any:
    """Return an array in 32 bits, or keys as threefry keys; anything else unchanged."""
    dtype = getattr(leaf, "dtype", None)
    if dtype is None:
        return leaf
    if is_key(dtype):
        if jax.random.key_impl(leaf) == PRNG:
            return leaf
        # JAX's other implementations hold a threefry key twice.
        return jax.random.wrap_key_data(jax.random.key_data(leaf)[..., :2], impl=PRNG)
    if dtype.str[1:] in ("f8", "i8", "u8", "c16"):
        return leaf.astype(f"{dtype.kind}{dtype.itemsize // 2}")
    return leaf
