"""Train one or several seeds of an algorithm in one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from pixelbrax_jax._platform.batches import map_runs
from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.runner.devices import mesh_of, state_shardings
from pixelbrax_jax.agents.train_state import Metrics, TrainState
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams


@dataclass(frozen=True)
class Runs:
    """``num_seeds`` runs of an algorithm; equal objects share compiled programs.

    Several runs add a leading axis to states and metrics. Without ``vmaps_runs`` a CPU computes one
    after another, because convolutions with one kernel per run are slow there.
    """

    algorithm: Algorithm
    num_seeds: int = 1

    @property
    def env(self) -> Any:
        """The environment, whose compiler options the programs have."""
        return self.algorithm.envs.env

    @jit(static_argnums=0)
    def init(self, seed: jax.Array, env_params: EnvParams) -> TrainState:
        """Return the initial state; the runs have consecutive seeds."""
        return self._spread(self._init(seed, env_params), {})[0]

    # Traced once for ``init`` and ``template``.
    @partial(jax.jit, static_argnums=0, inline=True)
    @under_default_flags
    def _init(self, seed: jax.Array, env_params: EnvParams) -> TrainState:
        if self.num_seeds == 1:
            keys = jax.random.key(seed)
        else:
            keys = jnp.stack([jax.random.key(seed + i) for i in range(self.num_seeds)])
        return self._each(self.algorithm.init, keys, env_params)

    # An iteration reuses the memory of the previous state.

    @jit(static_argnums=0, donate_argnums=1)
    def iterate(self, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """See ``Algorithm.iterate``."""
        return self._spread(*self._each(self.algorithm.iterate, state, env_params))

    @jit(static_argnums=0, donate_argnums=1)
    def auxiliary(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """See ``Algorithm.auxiliary``."""
        return self._spread(*self._each(self.algorithm.auxiliary, state))

    def template(self, env_params: EnvParams) -> TrainState:
        """Return shapes, dtypes and, with several devices, shardings of the state."""
        template: TrainState = Runs._init.eval_shape(self, np.uint32(0), env_params)
        mesh = mesh_of(self.algorithm)
        if mesh is None:
            return template
        shardings = state_shardings(mesh, template, self.num_seeds)
        return jax.tree.map(lambda leaf, place: leaf.update(sharding=place), template, shardings)

    def split(self, tree: Any) -> list[Any]:
        """Split a tree into the parts of each run."""
        if self.num_seeds == 1:
            return [tree]
        return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(self.num_seeds)]

    def _each(self, function: Callable[..., Any], first: Any, *others: Any) -> Any:
        if self.num_seeds == 1:
            return function(first, *others)

        def one(first: Any) -> Any:
            return function(first, *others)

        return jax.vmap(one)(first) if self.algorithm.vmaps_runs else map_runs(one, first)

    def _spread(self, state: TrainState, metrics: Metrics) -> tuple[TrainState, Metrics]:
        """Shard the state over the devices and replicate the metrics."""
        mesh = mesh_of(self.algorithm)
        if mesh is None:
            return state, metrics
        shardings = state_shardings(mesh, state, self.num_seeds)
        state = jax.lax.with_sharding_constraint(state, shardings)
        same = NamedSharding(mesh, PartitionSpec())
        return state, jax.lax.with_sharding_constraint(metrics, same)
