"""Several seeds of one algorithm, trained in one program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax._platform.batches import map_runs
from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.on_policy.losses import Metrics
from pixelbrax_jax.agents.train_state import TrainState
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams


@dataclass(frozen=True)
class Runs:
    """One or several runs of an algorithm, stepped by one program.

    With several, states and metrics have a leading axis S. On an accelerator the runs go side by
    side. On a CPU they take turns within the program: convolutions with a kernel for each run are
    slow there, and gain nothing.

    Attributes:
        algorithm: with its settings.
        num_seeds: S.
    """

    algorithm: Algorithm
    num_seeds: int = 1

    def keys(self, seed: int | jax.Array) -> jax.Array:
        """Return the keys of the seeds ``seed``, ``seed + 1``, ...: () of one run, else (S,)."""
        if self.num_seeds == 1:
            return jax.random.key(seed)
        return jnp.stack([jax.random.key(seed + i) for i in range(self.num_seeds)])

    @under_default_flags
    def init(self, seed: int | jax.Array, env_params: EnvParams) -> TrainState:
        """Return the state before the first iteration.

        Args:
            seed: () uint32, of the first run.
            env_params: of the environments.
        """
        return self._each(self.algorithm.init, self.keys(seed), env_params)

    def iterate(self, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """As ``Algorithm.iterate``."""
        return self._each(self.algorithm.iterate, state, env_params)

    def auxiliary(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """As ``Algorithm.auxiliary``."""
        return self._each(self.algorithm.auxiliary, state)

    def split(self, tree: Any) -> list[Any]:
        """Return each run's part of a tree."""
        if self.num_seeds == 1:
            return [tree]
        return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(self.num_seeds)]

    def _each(self, function: Callable[..., Any], first: Any, *others: Any) -> Any:
        """Map ``function`` over the runs of its first argument."""
        if self.num_seeds == 1:
            return function(first, *others)

        def one(first: Any) -> Any:
            return function(first, *others)

        return map_runs(one, first)
