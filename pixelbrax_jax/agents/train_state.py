"""The state of training, how its fields are sharded and stored, and its random keys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import jax
from flax import struct

from pixelbrax_jax.types import EnvState

Networks = dict[str, Any]
"""Parameters by network name."""

Metrics = dict[str, jax.Array]
"""Scalars by name."""

ENVS, NETWORKS, ACTIONS, UPDATES, AUXILIARY = range(5)
"""Random streams, folded into the key of a run."""

_AXES, _KEPT = "axes", "kept"


def along_envs(axis: int, *, kept: bool = True) -> Any:
    """Declare a field whose arrays have environments along ``axis``, which is split over devices.

    Checkpoints skip a field with ``kept=False``; a resumed run takes its value from ``init``.
    """
    return _field(lambda value: jax.tree.map(lambda _: axis, value), kept)


def without_envs(*, kept: bool = True) -> Any:
    """Declare a field without an environment axis, which is the same on every device."""
    return along_envs(-1, kept=kept)


def as_declared(leading_axes: int = 0, *, kept: bool = True) -> Any:
    """Declare a field whose class declares its own fields, behind ``leading_axes`` more axes."""

    def axes(value: Any) -> Any:
        own = None if value is None else env_axes(value)
        return jax.tree.map(lambda axis: axis + leading_axes if axis >= 0 else axis, own)

    return _field(axes, kept)


def _field(axes: Callable[[Any], Any], kept: bool) -> Any:
    return struct.field(metadata={_AXES: axes, _KEPT: kept})


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


def env_axes(tree: Any) -> Any:
    """Replace each leaf of a dataclass with declared fields by its environment axis, or -1."""
    found = {}
    for field in fields(tree):
        if _AXES not in field.metadata:
            raise TypeError(
                f"{type(tree).__name__}.{field.name} does not declare its environment axis: "
                "declare it with along_envs, without_envs or as_declared."
            )
        found[field.name] = field.metadata[_AXES](getattr(tree, field.name))
    return tree.replace(**found)


def parts_not_kept(state: TrainState) -> tuple[str, ...]:
    """Return the names of the fields that checkpoints skip."""
    return tuple(f.name for f in fields(state) if not f.metadata.get(_KEPT, True))


def kept(state: TrainState) -> TrainState:
    """Return the state with None for the fields that checkpoints skip."""
    return state.replace(**dict.fromkeys(parts_not_kept(state)))


def stream_key(state: TrainState, stream: int) -> jax.Array:
    """Return the key of a random stream, such as ``ACTIONS``, in this iteration."""
    return jax.random.fold_in(jax.random.fold_in(state.key, stream), state.iteration)
