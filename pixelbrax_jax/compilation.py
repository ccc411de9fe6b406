"""How XLA is asked to compile programs that draw images."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")

_WIDTH = "xla_cpu_prefer_vector_width"


def compiler_options() -> dict[str, int]:
    """Return options of ``jax.jit`` that make images fast on the default device.

    XLA holds back on CPUs with AVX-512 and computes with vectors of 256 bits; with 512 the
    ray-caster is up to twice as fast there. Other CPUs have no such vectors and are not affected;
    other devices need no options. Whatever PixelBrax compiles by itself for the Gymnasium, TorchRL
    and Stable-Baselines3 environments and for its agents has these options. A program of your own
    gets them at its outermost ``jax.jit``, the only one that takes options:

        step = jax.jit(env.step, compiler_options=pixelbrax_jax.compiler_options())

    Options change how XLA rounds: the same program with and without them agrees to rounding
    errors, not to the bit. A width that ``XLA_FLAGS`` names is kept, for every program alike.

    Returns:
        The options; empty on other devices than CPUs, with a width in ``XLA_FLAGS``, and with an
        XLA that does not know them.
    """
    if jax.default_backend() != "cpu" or _WIDTH in os.environ.get("XLA_FLAGS", ""):
        return {}
    return {_WIDTH: 512} if _is_known(_WIDTH) else {}


def jit(**options: Any) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorate as ``jax.jit`` does, with ``compiler_options``.

    They are asked for at the first call: importing a package must not start a device.

    Args:
        **options: of ``jax.jit``.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        @cache
        def program() -> Any:
            return jax.jit(function, compiler_options=compiler_options(), **options)

        @wraps(function)
        def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            return program()(*args, **kwargs)

        return call

    return decorate


@cache
def _is_known(option: str) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={option: 512}).lower(0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
