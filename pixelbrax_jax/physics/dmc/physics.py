"""Loading of the DM Control Suite's tasks."""

from __future__ import annotations

from functools import lru_cache

from pixelbrax_jax.physics.divergence import Recipe
from pixelbrax_jax.physics.dmc.domains import FORMULAS
from pixelbrax_jax.physics.dmc.models import load_spec
from pixelbrax_jax.physics.dmc.tasks import TASKS
from pixelbrax_jax.physics.mujoco.options import MujocoOptions
from pixelbrax_jax.physics.mujoco.physics import MujocoPhysics


def make_physics(task: str, *, engine: str = "auto", num_starts: int = 0) -> MujocoPhysics:
    """Make the physics of a task in ``TASKS``. Equal arguments give equal objects."""
    options = MujocoOptions(engine=engine, num_starts=num_starts)
    return _load(task, options.engine, options.num_starts)


# Loading a model takes a second. A model that is loaded again equals the first one.
@lru_cache(maxsize=16)
def _load(task: str, engine: str, num_starts: int) -> MujocoPhysics:
    formulas = FORMULAS[task]
    spec = load_spec(TASKS[task].domain, **formulas.options)
    return MujocoPhysics(
        formulas,
        spec,
        engine=engine,
        num_starts=num_starts,
        identity=Recipe(_load, (task, engine, num_starts)),
    )
