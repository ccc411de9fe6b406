"""Loading of the DM Control Suite's tasks."""

from __future__ import annotations

from functools import lru_cache

from pixelbrax_jax.physics.divergence import Recipe
from pixelbrax_jax.physics.dmc.domains import FORMULAS
from pixelbrax_jax.physics.dmc.models import load_spec
from pixelbrax_jax.physics.dmc.tasks import TASKS
from pixelbrax_jax.physics.mujoco.options import MujocoOptions
from pixelbrax_jax.physics.mujoco.physics import MujocoPhysics


# Loading a model takes a second. A model that is loaded again equals the first one.
@lru_cache(maxsize=16)
def load(task: str, options: MujocoOptions) -> MujocoPhysics:
    """Load the physics of a task in ``TASKS``. Equal arguments give equal objects."""
    formulas = FORMULAS[task]
    spec = load_spec(TASKS[task].domain, **formulas.options)
    return MujocoPhysics(
        formulas,
        spec,
        **vars(options),
        identity=Recipe(load, (task, options)),
    )
