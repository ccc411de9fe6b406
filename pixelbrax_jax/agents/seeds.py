"""Several seeds of one algorithm, trained in one program."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.algorithm import Algorithm


def over_seeds(algorithm: Algorithm) -> Algorithm:
    """The algorithm for (S,) keys, each of which is a run of its own.

    States and metrics get a leading axis S. ``act`` stays that of one run.
    """
    auxiliary = algorithm.auxiliary
    return replace(
        algorithm,
        init=jax.vmap(algorithm.init, in_axes=(0, None)),
        iterate=jax.vmap(algorithm.iterate, in_axes=(0, None)),
        auxiliary=None if auxiliary is None else jax.vmap(auxiliary),
    )


def keys_of(seed: int, number: int) -> jax.Array:
    """Keys of the seeds ``seed``, ``seed + 1``, ...; (number,)."""
    return jnp.stack([jax.random.key(seed + i) for i in range(number)])


def of_seed(tree: Any, index: int) -> Any:
    """One run of several."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
