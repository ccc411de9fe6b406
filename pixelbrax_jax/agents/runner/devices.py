"""Several devices and processes: how a state is spread, what all must agree on, what fits.

What belongs to environments is spread along them; everything else is the same on every device. A
minibatch has equally many steps of every environment, so that each device computes the gradient of
its own, and XLA adds them up.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax._platform.lowering import default_platform
from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.runner.progress import Report
from pixelbrax_jax.agents.train_state import TrainState, env_axes
from pixelbrax_jax.envs.sharded import AXIS
from pixelbrax_jax.memory import device_memory


def mesh_of(algorithm: Algorithm) -> Mesh | None:
    """Return the devices over which an algorithm's environments are spread, if they are."""
    mesh: Mesh | None = getattr(algorithm.envs, "mesh", None)
    return mesh


def state_shardings(mesh: Mesh, template: Any, num_seeds: int = 1) -> Any:
    """Return a sharding for each leaf of a ``TrainState``, or of its ``jax.eval_shape``.

    The mesh has an axis ``"envs"``. Of several seeds the leaves have a leading axis.
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


def check_memory(algorithm: Algorithm, template: TrainState, report: Report) -> None:
    """Report what a state like ``template`` takes, or raise a MemoryError if it would not fit."""
    config = algorithm.config
    frames = config.bytes_per_iteration * template.iteration.size
    memories, total = _memories(algorithm), _nbytes(template)
    parts = {field.name: _nbytes(getattr(template, field.name)) for field in fields(template)}
    large = (f", {name} {n / 1e9:.2f} GB" for name, n in parts.items() if n > 0.01 * total)
    report(
        f"stored: frames of an iteration {frames / 1e9:.2f} GB, all state {total / 1e9:.2f} GB"
        + "".join(large)
    )
    # What belongs to environments is spread over the devices; the rest is the same on all.
    leaves = zip(jax.tree.leaves(template), jax.tree.leaves(env_axes(template)), strict=True)
    alike = sum(_nbytes(leaf) for leaf, axis in leaves if axis < 0)
    needed = alike + (frames + total - alike) / memories
    budget = config.memory_budget_gb
    limit = budget * 1e9 if budget is not None else device_memory()
    if any_process(needed > limit):
        where = f" in each of {memories} memories" if memories > 1 else ""
        raise MemoryError(
            f"frames and state take {needed / 1e9:.2f} GB{where}, of {limit / 1e9:.2f} GB that "
            f"may be used. Lower {', '.join(config.memory_settings)} or the size of the images, or "
            "raise memory_budget_gb."
        )


def _nbytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def _memories(algorithm: Algorithm) -> int:
    """Return memories over which environments are spread; devices of a CPU share one."""
    mesh = mesh_of(algorithm)
    if mesh is None:
        return 1
    return jax.process_count() if default_platform() == "cpu" else int(mesh.size)
