"""Where the parts of a training state live, when there are several devices.

What belongs to environments is spread along them; networks, their moments and counters are the
same everywhere. A minibatch has equally many steps of every environment, so that each device
computes the gradient of its own, and XLA adds them up.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax.envs.sharded import AXIS


def state_shardings(mesh: Mesh, template: Any, num_seeds: int = 1) -> Any:
    """A sharding for each leaf of a ``TrainState``.

    Args:
        mesh: devices along an axis ``"envs"``.
        template: the state, or its ``jax.eval_shape``.
        num_seeds: if more than 1, leaves have a leading axis of that size.
    """

    def of(path: Any, leaf: Any) -> NamedSharding:
        del leaf
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if name.startswith("env_state.") or name == "scaler.discounted":
            before = 0
        elif name == "buffer.frames.shift":
            before = 1
        elif name.startswith("buffer."):
            before = 2
        else:
            return NamedSharding(mesh, PartitionSpec())
        before += num_seeds > 1
        return NamedSharding(mesh, PartitionSpec(*[None] * before, AXIS))

    return jax.tree_util.tree_map_with_path(of, template)


def everywhere(mesh: Mesh, tree: Any) -> Any:
    """The same values on all devices of all processes."""
    same = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf), same), tree)


def anywhere(here: bool) -> bool:
    """Whether something is so in any process, when all must go the same way."""
    return bool(highest(int(here))[0])


def highest(*here: int) -> tuple[int, ...]:
    """Return the highest of each number over all processes, when all must go the same way."""
    if jax.process_count() == 1:
        return here
    everyone = multihost_utils.process_allgather(np.array(here, np.int32))
    return tuple(int(number) for number in everyone.max(axis=0))
