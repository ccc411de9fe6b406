"""Dynamics: what moves, what it earns, when it ends. One folder for each engine."""

from __future__ import annotations

from importlib import import_module

from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.physics.opengl import import_mujoco
from pixelbrax_jax.tasks import TASKS
from pixelbrax_jax.validation import check_choice

import_mujoco()  # before any module below does


@default_flags()
def make_physics(task: str, *, backend: str | None = None, reward_preset: str = "brax") -> Physics:
    """Make the physics of a built-in task, by the engine of its row.

    Args:
        task: a name in ``TASKS``.
        backend: a physics backend that the task supports; None for its default.
        reward_preset: ``"brax"`` or ``"paper"``.

    Returns:
        The physics; equal arguments give equal objects.

    Raises:
        ValueError: for an unknown name; the message lists what is allowed.
        ImportError: the task's models come from a package that is not installed; the message has
            the line that installs it.
    """
    engine = TASKS[check_choice("task", task, TASKS)].engine
    module = import_module(f"pixelbrax_jax.physics.{engine}.tasks")
    physics: Physics = module.make_physics(task, backend=backend, reward_preset=reward_preset)
    return physics
