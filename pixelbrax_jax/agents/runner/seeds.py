"""Several seeds of one algorithm, trained in one program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.core.algorithm import Algorithm


def over_seeds(algorithm: Algorithm) -> Algorithm:
    """The algorithm for (S,) keys, each of which is a run of its own.

    States and metrics get a leading axis S. ``act`` stays that of one run. On an accelerator the
    runs go side by side. On a CPU they take turns within the program: convolutions with a kernel
    for each run are slow there, and gain nothing.
    """
    auxiliary = algorithm.auxiliary
    return replace(
        algorithm,
        init=_mapped(algorithm.init),
        iterate=_mapped(algorithm.iterate),
        auxiliary=None if auxiliary is None else _mapped(auxiliary),
    )


def _mapped(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` over the leading axis of its first argument."""

    def mapped(first: Any, *others: Any) -> Any:
        def one(first: Any) -> Any:
            return function(first, *others)

        return jax.lax.map(one, first) if jax.default_backend() == "cpu" else jax.vmap(one)(first)

    return mapped


def keys_of(seed: int, number: int) -> jax.Array:
    """Keys of the seeds ``seed``, ``seed + 1``, ...; (number,)."""
    return jnp.stack([jax.random.key(seed + i) for i in range(number)])


def of_seed(tree: Any, index: int) -> Any:
    """One run of several."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
