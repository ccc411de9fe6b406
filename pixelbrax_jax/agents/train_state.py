"""Where training stands, and the random keys that follow from it."""

from __future__ import annotations

import warnings
from typing import Any

import jax
from flax import struct

from pixelbrax_jax.agents.env_axis import along_envs, as_declared, without_envs
from pixelbrax_jax.agents.on_policy.returns import RewardScaler
from pixelbrax_jax.agents.optimizer import Networks
from pixelbrax_jax.types import EnvState

_ENVS, _NETWORKS, _ACTIONS, _UPDATES, _AUXILIARY = range(5)
"""Names of random streams, folded into the key of a run."""


class TrainState(struct.PyTreeNode):
    """Where training stands; all of it, so that a run goes on from it as if never stopped.

    Attributes:
        networks: parameters by name of the network.
        opt_state: of the optimiser, by name of the network.
        aux_opt_state: of the optimiser of the auxiliary phase; None where there is none.
        env_state: where the environments are.
        scaler: statistics of rewards.
        buffer: what the auxiliary phase will learn from; None where there is none.
        key: typed PRNG key of the run; never changes.
        iteration: () uint32, rollouts so far, of ``config.steps_per_iteration`` control steps each.
    """

    networks: Networks = without_envs()
    opt_state: Networks = without_envs()
    aux_opt_state: Networks | None = without_envs()
    env_state: EnvState = along_envs(0)
    scaler: RewardScaler = as_declared()
    buffer: Any = as_declared()
    key: jax.Array = without_envs()
    iteration: jax.Array = without_envs()

    @property
    def moments(self) -> Networks:
        """The former name of ``opt_state``, which goes with the next release."""
        warnings.warn("TrainState.moments is opt_state now.", DeprecationWarning, stacklevel=2)
        return self.opt_state


def env_key(key: jax.Array) -> jax.Array:
    """Return the environments' key of a run."""
    return jax.random.fold_in(key, _ENVS)


def network_key(key: jax.Array) -> jax.Array:
    """Return the key of a run's initial parameters."""
    return jax.random.fold_in(key, _NETWORKS)


def action_key(state: TrainState) -> jax.Array:
    """Return the key of this iteration's actions."""
    return jax.random.fold_in(jax.random.fold_in(state.key, _ACTIONS), state.iteration)


def update_key(state: TrainState) -> jax.Array:
    """Return the key of this iteration's update."""
    return jax.random.fold_in(jax.random.fold_in(state.key, _UPDATES), state.iteration)


def auxiliary_key(state: TrainState) -> jax.Array:
    """Return the key of the auxiliary phase that follows this iteration."""
    return jax.random.fold_in(jax.random.fold_in(state.key, _AUXILIARY), state.iteration)
