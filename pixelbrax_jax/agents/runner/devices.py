"""Several devices and processes: how a state is spread, what all must agree on, what fits.

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
from pixelbrax_jax.agents.env_axis import env_axes
from pixelbrax_jax.agents.runner.progress import Report
from pixelbrax_jax.agents.train_state import TrainState
from pixelbrax_jax.envs.sharded import AXIS
from pixelbrax_jax.memory import device_memory


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


def check_memory(algorithm: Algorithm, template: TrainState, report: Report) -> None:
    """Report what will be stored, and reject what would not fit.

    Args:
        algorithm: with its settings.
        template: ``jax.eval_shape`` of its state.
        report: gets the figures.

    Raises:
        MemoryError: it is more than ``memory_budget_gb``, or than the device has.
    """
    config, env = algorithm.config, algorithm.config.env
    frame = config.num_envs * env.height * env.width * 3
    rollout = frame * (config.num_steps + env.frame_stack - 1) * template.iteration.size
    buffer, state = _nbytes(template.buffer), _nbytes(template)
    alike = _nbytes((template.networks, template.opt_state, template.aux_opt_state))
    parts = _memories(algorithm)
    stored = alike + (rollout + state - alike) / parts
    report(
        f"stored: rollout {rollout / 1e9:.2f} GB, auxiliary buffer {buffer / 1e9:.2f} GB, all "
        f"state {state / 1e9:.2f} GB"
    )
    budget = config.memory_budget_gb
    limit = budget * 1e9 if budget is not None else device_memory()
    if any_process(stored > limit):
        where = f" in each of {parts} memories" if parts > 1 else ""
        raise MemoryError(
            f"rollout and state take {stored / 1e9:.2f} GB{where}, of {limit / 1e9:.2f} GB that "
            f"may be used. Lower num_envs, num_steps{', num_policy_phases' if buffer else ''} or "
            "the size of the images, or raise memory_budget_gb."
        )


def _nbytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def _memories(algorithm: Algorithm) -> int:
    """Return memories over which environments are spread; devices of a CPU share one."""
    mesh = mesh_of(algorithm)
    if mesh is None:
        return 1
    return jax.process_count() if jax.default_backend() == "cpu" else int(mesh.size)
