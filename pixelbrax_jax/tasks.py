"""All built-in tasks by suite. Importing it loads neither JAX nor physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
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

    ``loader`` is the module with ``load(task, options)``, and ``options`` the dataclass of the
    options that only these tasks take.
    """

    title: str
    tasks: Mapping[str, Task]
    loader: str
    options: type[BraxOptions | MujocoOptions]

    def takes(self, option: str) -> bool:
        """Return whether the tasks have an option of this name."""
        return option in {field.name for field in fields(self.options)}


SUITES: Mapping[str, Suite] = MappingProxyType(
    {
        "brax": Suite(
            "Brax's tasks",
            BRAX_TASKS,
            "pixelbrax_jax.physics.brax.loading",
            BraxOptions,
        ),
        "dmc": Suite(
            "tasks of the DM Control Suite",
            DMC_TASKS,
            "pixelbrax_jax.physics.dmc.physics",
            MujocoOptions,
        ),
        "gym": Suite(
            "Gymnasium's MuJoCo tasks",
            GYM_TASKS,
            "pixelbrax_jax.physics.gym.physics",
            MujocoOptions,
        ),
    }
)
"""Suites by the names that ``list_envs`` takes."""

TASKS: Mapping[str, Task] = MappingProxyType(
    {name: task for suite in SUITES.values() for name, task in suite.tasks.items()}
)
"""All built-in tasks by name."""
