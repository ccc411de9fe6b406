"""Loading of the DM Control Suite's tasks."""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module

from pixelbrax_jax.physics.divergence import Recipe
from pixelbrax_jax.physics.mjx.engine import MjxPhysics
from pixelbrax_jax.physics.mjx.formulas import Formulas
from pixelbrax_jax.physics.mjx.models import load_model
from pixelbrax_jax.physics.mjx.tasks import TASKS


def make_physics(task: str) -> MjxPhysics:
    """Make the physics of a task in ``mjx.tasks.TASKS``; equal and usually the same for one task.

    Raises:
        ImportError: dm_control is not installed; the message has the command that installs it.
    """
    return _load(task)


def formulas_of(task: str) -> Formulas:
    """Return the formulas of a task."""
    row = TASKS[task]
    module = import_module(f"pixelbrax_jax.physics.mjx.domains.{row.domain}")
    formulas: Formulas = module.TASKS[row.task]
    return formulas


# Loading a model takes a second. A model that is loaded again equals the first one.
@lru_cache(maxsize=16)
def _load(task: str) -> MjxPhysics:
    formulas = formulas_of(task)
    model = load_model(TASKS[task].domain, **formulas.options)
    return MjxPhysics(formulas, model, identity=Recipe(_load, (task,)))
