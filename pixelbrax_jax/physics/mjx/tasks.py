"""The tasks of the DM Control Suite, by name."""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module

from pixelbrax_jax.physics.mjx.engine import MjxPhysics
from pixelbrax_jax.physics.mjx.models import load_model
from pixelbrax_jax.physics.mjx.task import DmcTask
from pixelbrax_jax.physics.recipe import Recipe
from pixelbrax_jax.tasks import DMC_TASKS
from pixelbrax_jax.validation import check_choice


def make_physics(
    task: str, *, backend: str | None = None, reward_preset: str = "brax"
) -> MjxPhysics:
    """Make the physics of a task of the DM Control Suite.

    Equal arguments give equal objects, and the same one as long as few others are asked for.

    Args:
        task: a name in ``DMC_TASKS``.
        backend: ``"mjx"``, or None for the same.
        reward_preset: ``"brax"``, which is the only one here: rewards are DM Control's.

    Returns:
        The physics.

    Raises:
        ImportError: dm_control is not installed; the message has the line that installs it.
        ValueError: for an unknown name; the message lists what is allowed.
    """
    row = DMC_TASKS[check_choice("task", task, DMC_TASKS)]
    if backend is not None:
        check_choice(f"backend of task {task!r}", backend, row.backends)
    if reward_preset != "brax":
        raise ValueError(
            f"reward_preset={reward_preset!r}, but task {task!r} has DM Control's own rewards: "
            "leave the option out."
        )
    return _load(task)


def dmc_task(task: str) -> DmcTask:
    """Return what a task consists of.

    Args:
        task: a name in ``DMC_TASKS``.

    Returns:
        Its model, initial states, observation and reward.

    Raises:
        ValueError: there is no such task; the message lists those there are.
    """
    row = DMC_TASKS[check_choice("task", task, DMC_TASKS)]
    module = import_module(f"pixelbrax_jax.physics.mjx.domains.{row.domain}")
    parts: DmcTask = module.TASKS[row.task]
    return parts


# Loading a model takes a second. One that is dropped and loaded again equals the first.
@lru_cache(maxsize=16)
def _load(task: str) -> MjxPhysics:
    parts = dmc_task(task)
    model = load_model(parts.domain, **parts.options)
    return MjxPhysics(parts, model, identity=Recipe(_load, (task,)))
