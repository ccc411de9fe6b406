"""A training state spread over several devices, and what all processes must agree on.

What belongs to environments is spread along them; everything else is the same on every device. A
minibatch has equally many steps of every environment, so that each device computes the gradient of
its own, and XLA adds them up.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.train_state import env_axes
from pixelbrax_jax.envs.sharded import AXIS


def mesh_of(algorithm: Algorithm) -> Mesh | None:
    """Return the devices over which an algorithm's environments are spread, if they are."""
    mesh: Mesh | None = getattr(algorithm.envs, "mesh", None)
    return mesh


def state_shardings(mesh: Mesh, template: Any, num_seeds: int = 1) -> Any:
    """Return a sharding for each leaf of a ``TrainState``.

    Args:
        mesh: devices along an axis ``"envs"``.
        template: the state, or its ``jax.eval_shape``.
        num_seeds: if more than 1, leaves have a leading axis of that size.

    Raises:
        TypeError: a field does not say where its environments are.
    """

    def sharding(axis: int) -> NamedSharding:
        if axis < 0:
            return replicated(mesh)
        return NamedSharding(mesh, PartitionSpec(*[None] * (axis + (num_seeds > 1)), AXIS))

    return jax.tree.map(sharding, env_axes(template))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of what is the same on all devices."""
    return NamedSharding(mesh, PartitionSpec())


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Put the same values on all devices of all processes."""
    same = replicated(mesh)
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf), same), tree)


def any_process(here: bool) -> bool:
    """Return whether something is so in any process, when all must go the same way."""
    return bool(highest(int(here))[0])


def highest(*here: int) -> tuple[int, ...]:
    """Return the highest of each number over all processes, when all must go the same way."""
    if jax.process_count() == 1:
        return here
    everyone = multihost_utils.process_allgather(np.array(here, np.int32))
    return tuple(int(number) for number in everyone.max(axis=0))
