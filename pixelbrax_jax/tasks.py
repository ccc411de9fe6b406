"""All built-in tasks by suite. Importing it loads neither JAX nor physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from pixelbrax_jax.physics.brax.tasks import TASKS as BRAX_TASKS
from pixelbrax_jax.physics.brax.tasks import BraxOptions
from pixelbrax_jax.physics.dmc.tasks import TASKS as DMC_TASKS
from pixelbrax_jax.physics.gym.tasks import TASKS as GYM_TASKS
from pixelbrax_jax.physics.mujoco.options import MujocoOptions
from pixelbrax_jax.physics.task import Task


@dataclass(frozen=True, eq=False)
class Suite:
    """Tasks by name that one engine simulates.

    ``options`` is the dataclass of the options that only these tasks take.
    """

    title: str
    tasks: Mapping[str, Task]
    options: type[BraxOptions | MujocoOptions]


SUITES: Mapping[str, Suite] = MappingProxyType(
    {
        "brax": Suite("Brax's tasks", BRAX_TASKS, BraxOptions),
        "dmc": Suite("tasks of the DM Control Suite", DMC_TASKS, MujocoOptions),
        "gym": Suite("Gymnasium's MuJoCo tasks", GYM_TASKS, MujocoOptions),
    }
)
"""Suites by the names that ``list_envs`` takes.

``load(task, options)`` of the module ``physics.<name>.loading`` makes the physics of a task.
"""

TASKS: Mapping[str, Task] = MappingProxyType(
    {name: task for suite in SUITES.values() for name, task in suite.tasks.items()}
)
"""All built-in tasks by name."""
