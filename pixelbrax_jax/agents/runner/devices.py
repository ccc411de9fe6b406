"""Sharding over devices, agreement between processes, and the memory check."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.runner.progress import Report
from pixelbrax_jax.agents.train_state import TrainState, env_axes
from pixelbrax_jax.envs.sharded import AXIS
from pixelbrax_jax.memory import device_memory


def mesh_of(algorithm: Algorithm) -> Mesh | None:
    """Return the device mesh of an algorithm's environments, or None."""
    return getattr(algorithm.envs, "mesh", None)


def state_shardings(mesh: Mesh, template: Any, num_seeds: int = 1) -> Any:
    """Return the shardings of a ``TrainState``: environments over the mesh, the rest replicated."""

    def sharding(axis: int) -> NamedSharding:
        places = (*[None] * (axis + (num_seeds > 1)), AXIS) if axis >= 0 else ()
        return NamedSharding(mesh, PartitionSpec(*places))

    return jax.tree.map(sharding, env_axes(template))


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Copy values to all devices of all processes."""
    return jax.device_put(jax.tree.map(np.asarray, tree), NamedSharding(mesh, PartitionSpec()))


def any_process(here: bool) -> bool:
    """Return whether the flag is set in any process."""
    return bool(highest(int(here))[0])


def highest(*here: int) -> tuple[int, ...]:
    """Return the maximum of each number over all processes."""
    if jax.process_count() == 1:
        return here
    everyone = multihost_utils.process_allgather(np.array(here, np.int32))
    return tuple(int(number) for number in everyone.max(axis=0))


def check_memory(algorithm: Algorithm, template: TrainState, report: Report) -> None:
    """Report the memory of a state like ``template``; raise a MemoryError if it does not fit."""
    config = algorithm.config
    frames = config.bytes_per_iteration * template.iteration.size
    # Devices of a CPU share one memory.
    mesh = mesh_of(algorithm)
    sharing = 1 if mesh is None else int(mesh.size)
    memories = min(sharing, jax.process_count()) if jax.default_backend() == "cpu" else sharing
    total = _nbytes(template)
    parts = {field.name: _nbytes(getattr(template, field.name)) for field in fields(template)}
    large = (f", {name} {n / 1e9:.2f} GB" for name, n in parts.items() if n > 0.01 * total)
    report(
        f"stored: frames of an iteration {frames / 1e9:.2f} GB, all state {total / 1e9:.2f} GB"
        + "".join(large)
    )
    # Devices share the environments; every device holds the rest.
    leaves = zip(jax.tree.leaves(template), jax.tree.leaves(env_axes(template)), strict=True)
    alike = sum(_nbytes(leaf) for leaf, axis in leaves if axis < 0)
    needed = alike + (frames + total - alike) / memories
    budget = config.memory_budget_gb
    limit = budget * 1e9 if budget is not None else device_memory()
    if any_process(needed > limit):
        where = f" in each of {memories} memories" if memories > 1 else ""
        raise MemoryError(
            f"frames and state need {needed / 1e9:.2f} GB{where}, but only {limit / 1e9:.2f} GB "
            f"may be used. {config.to_fit((needed - limit) * memories / template.iteration.size)}"
        )


def _nbytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
