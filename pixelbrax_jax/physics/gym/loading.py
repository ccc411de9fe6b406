"""Loading of Gymnasium's MuJoCo tasks."""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from pixelbrax_jax.physics.divergence import Recipe
from pixelbrax_jax.physics.gym.formulas import FORMULAS
from pixelbrax_jax.physics.gym.tasks import TASKS, GymTask
from pixelbrax_jax.physics.mujoco.native import compile_model
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.options import MujocoOptions
from pixelbrax_jax.physics.mujoco.physics import MujocoPhysics
from pixelbrax_jax.spatial import make_rig
from pixelbrax_jax.types import CameraRig


# Loading a model takes a second. A model that is loaded again equals the first one.
@lru_cache(maxsize=16)
def load(task: str, options: MujocoOptions) -> MujocoPhysics:
    """Load the physics of a task in ``TASKS``. Equal arguments give equal objects."""
    spec = mujoco.MjSpec.from_file(str(_assets() / TASKS[task].model))
    return MujocoPhysics(
        FORMULAS[task],
        spec,
        **vars(options),
        time_limit=TASKS[task].time_limit,
        rigs={"free": free_camera(TASKS[task], spec)},
        identity=Recipe(load, (task, options)),
    )


def _assets() -> Path:
    """Return Gymnasium's folder of models, without importing its environments."""
    found = find_spec("gymnasium")
    return Path(str(found and found.origin)).parent / "envs" / "mujoco" / "assets"


def free_camera(task: GymTask, spec: mujoco.MjSpec) -> CameraRig:
    """Return the viewpoint of Gymnasium's ``render``, which follows nothing."""
    model = compile_model(spec)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    lookat = np.median(data.geom_xpos, axis=0) if task.lookat is None else np.array(task.lookat)
    distance = model.stat.extent if task.distance is None else task.distance
    elevation = np.radians(task.elevation)
    # MuJoCo's default azimuth: along +y.
    forward = np.array([0.0, np.cos(elevation), np.sin(elevation)])
    return make_rig(lookat - distance * forward, lookat, float(model.vis.global_.fovy))
