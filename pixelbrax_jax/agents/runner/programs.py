"""The compiled programs of training; equal runs share them."""

from __future__ import annotations

from typing import Any

import jax

from pixelbrax_jax.agents.runner.seeds import Runs
from pixelbrax_jax.agents.runner.sharding import mesh_of, replicated, state_shardings
from pixelbrax_jax.agents.train_state import Metrics, TrainState
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.types import EnvParams


def _env(runs: Runs) -> Any:
    return runs.algorithm.envs.env


@jit(_env, static_argnums=0)
def init(runs: Runs, seed: jax.Array, env_params: EnvParams) -> TrainState:
    """As ``Runs.init``."""
    return _spread(runs, runs.init(seed, env_params), {})[0]


# The state before an iteration is not needed after it: its memory is used again.


@jit(_env, static_argnums=0, donate_argnums=1)
def iterate(runs: Runs, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
    """As ``Runs.iterate``."""
    return _spread(runs, *runs.iterate(state, env_params))


@jit(_env, static_argnums=0, donate_argnums=1)
def auxiliary(runs: Runs, state: TrainState) -> tuple[TrainState, Metrics]:
    """As ``Runs.auxiliary``."""
    return _spread(runs, *runs.auxiliary(state))


def _spread(runs: Runs, state: TrainState, metrics: Metrics) -> tuple[TrainState, Metrics]:
    """Spread the state over the devices, and give all of them the metrics."""
    mesh = mesh_of(runs.algorithm)
    if mesh is None:
        return state, metrics
    shardings = state_shardings(mesh, state, runs.num_seeds)
    state = jax.lax.with_sharding_constraint(state, shardings)
    return state, jax.lax.with_sharding_constraint(metrics, replicated(mesh))
