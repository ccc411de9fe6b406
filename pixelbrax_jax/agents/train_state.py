"""The state of training, how its fields are sharded and stored, and its random keys."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import jax
from flax import struct

from pixelbrax_jax.types import EnvState

Networks = dict[str, Any]
"""Parameters by network name."""

Metrics = dict[str, jax.Array]
"""Scalars by name."""

_ENV_AXIS, _KEPT, _NONE = "env_axis", "kept", "none"
_ENVS, _NETWORKS, _ACTIONS, _UPDATES, _AUXILIARY = range(5)
"""Random streams, folded into the key of a run."""


def along_envs(axis: int, *, kept: bool = True) -> Any:
    """Declare a field whose arrays have environments along ``axis``, which is split over devices.

    Checkpoints skip a field with ``kept=False``; a resumed run takes its value from ``init``.
    """
    return struct.field(metadata={_ENV_AXIS: axis, _KEPT: kept})


def without_envs(*, kept: bool = True) -> Any:
    """Declare a field without an environment axis, which is the same on every device."""
    return struct.field(metadata={_ENV_AXIS: _NONE, _KEPT: kept})


def as_declared(leading_axes: int = 0, *, kept: bool = True) -> Any:
    """Declare a field whose class declares its fields; its arrays have more ``leading_axes``."""
    return struct.field(metadata={_ENV_AXIS: ("class", leading_axes), _KEPT: kept})


class TrainState(struct.PyTreeNode):
    """The state from which every algorithm can continue a run.

    A subclass declares each further field with ``along_envs``, ``without_envs`` or ``as_declared``.

    Attributes:
        networks, opt_state: parameters and optimiser state by network name.
        key: typed PRNG key of the run; constant.
        iteration: () uint32, iterations so far, of ``config.steps_per_iteration`` control steps.
    """

    networks: Networks = without_envs()
    opt_state: Networks = without_envs()
    env_state: EnvState = along_envs(0)
    key: jax.Array = without_envs()
    iteration: jax.Array = without_envs()


State = TypeVar("State", bound=TrainState)


def env_axes(tree: Any) -> Any:
    """Replace each leaf of a dataclass by its environment axis, or -1 if it has none.

    Raises:
        TypeError: a field is not declared, or its class declares no fields.
    """
    found = {}
    for field in fields(tree):
        value, declared = getattr(tree, field.name), field.metadata.get(_ENV_AXIS)
        if declared is None:
            raise TypeError(
                f"{type(tree).__name__}.{field.name} does not declare its environment axis: "
                "declare it with along_envs, without_envs or as_declared."
            )
        if isinstance(declared, tuple) and value is not None:
            if not is_dataclass(value):
                raise TypeError(
                    f"{type(tree).__name__}.{field.name} must be a dataclass that declares its "
                    f"fields, got a {type(value).__name__}."
                )
            more = declared[1]
            found[field.name] = jax.tree.map(
                lambda axis, more=more: axis + more if axis >= 0 else axis, env_axes(value)
            )
        else:
            axis = declared if isinstance(declared, int) else -1
            found[field.name] = jax.tree.map(lambda _, axis=axis: axis, value)
    return tree.replace(**found)


def parts_not_kept(state: TrainState) -> tuple[str, ...]:
    """Return the names of the fields that checkpoints skip."""
    return tuple(f.name for f in fields(state) if not f.metadata.get(_KEPT, True))


def kept(state: State) -> State:
    """Return the state with None for the fields that checkpoints skip."""
    without: State = state.replace(**dict.fromkeys(parts_not_kept(state)))
    return without


def env_key(key: jax.Array) -> jax.Array:
    """Return the key of a run's environments."""
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
