"""Where training stands: what each part declares, and the random keys that follow from it.

Several devices share the environments: what belongs to environments is spread along them, and
everything else is the same on every device. Each field says which of the two it is, and whether a
checkpoint keeps it.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import jax
from flax import struct

from pixelbrax_jax.types import EnvState

Networks = dict[str, Any]
"""Parameters by name of the network."""

Metrics = dict[str, jax.Array]
"""Scalars by name."""

_ENV_AXIS, _KEPT, _NONE = "env_axis", "kept", "none"
_ENVS, _NETWORKS, _ACTIONS, _UPDATES, _AUXILIARY = range(5)
"""Names of random streams, folded into the key of a run."""


def along_envs(axis: int, *, kept: bool = True) -> Any:
    """Declare a field whose arrays have the environments along ``axis``.

    Checkpoints leave out what is not ``kept``; a resumed run begins with that of ``init``.
    """
    return struct.field(metadata={_ENV_AXIS: axis, _KEPT: kept})


def without_envs(*, kept: bool = True) -> Any:
    """Declare a field that belongs to no environment."""
    return struct.field(metadata={_ENV_AXIS: _NONE, _KEPT: kept})


def as_declared(leading_axes: int = 0, *, kept: bool = True) -> Any:
    """Declare a field whose own class declares its fields, but for ``leading_axes`` more."""
    return struct.field(metadata={_ENV_AXIS: ("class", leading_axes), _KEPT: kept})


class TrainState(struct.PyTreeNode):
    """What every algorithm needs to go on as if it had never stopped.

    An algorithm that needs more adds fields in a subclass, each declared by one of the functions
    above.

    Attributes:
        networks: parameters by name of the network.
        opt_state: of the optimiser, by name of the network.
        env_state: where the environments are.
        key: typed PRNG key of the run; never changes.
        iteration: () uint32, iterations so far, of ``config.steps_per_iteration`` control steps.
    """

    networks: Networks = without_envs()
    opt_state: Networks = without_envs()
    env_state: EnvState = along_envs(0)
    key: jax.Array = without_envs()
    iteration: jax.Array = without_envs()


State = TypeVar("State", bound=TrainState)


def env_axes(tree: Any) -> Any:
    """Return a dataclass of declared fields with each leaf's axis of environments, or -1.

    Raises:
        TypeError: a field is not declared, or is none of the class that shall declare it.
    """
    found = {}
    for field in fields(tree):
        value, declared = getattr(tree, field.name), field.metadata.get(_ENV_AXIS)
        if declared is None:
            raise TypeError(
                f"{type(tree).__name__}.{field.name} does not say where its environments are: "
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
    """Return the names of the fields that checkpoints leave out."""
    return tuple(f.name for f in fields(state) if not f.metadata.get(_KEPT, True))


def kept(state: State) -> State:
    """Return a state as checkpoints have it: None in place of the parts that they leave out."""
    without: State = state.replace(**dict.fromkeys(parts_not_kept(state)))
    return without


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
