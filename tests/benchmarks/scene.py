"""A task's model and our view of it, for other renderers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import brax.envs
import jax
import mujoco
import numpy as np

import pixelbrax_jax as pb
from pixelbrax_jax.scene.place import place


def describe(task: str) -> dict[str, Any]:
    """The MJCF that Brax loads, and where our camera stands at the start of an episode.

    Returns:
        ``xml``; ``pos`` (3,) metres and ``quat`` (4,) of the camera in the world frame; ``fovy``
        in degrees; ``qpos``, the joints' positions then.
    """
    file = Path(brax.envs.__file__).parent / "assets" / f"{_FILES.get(task, task)}.xml"
    env, params = pb.make(task)
    state, _ = env.reset(jax.random.key(0), params)
    physics = state.sim.physics
    scene = place(params.geoms, params.rig, params.look, physics.xpos, physics.xquat)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(scene.camera.xmat, np.float64).ravel())
    return {
        "xml": file.read_text(),
        "pos": np.asarray(scene.camera.pos).tolist(),
        "quat": quat.tolist(),
        "fovy": float(scene.camera.fovy),
        "qpos": np.asarray(physics.engine.pipeline.q).tolist(),
    }


_FILES = {"halfcheetah": "half_cheetah"}
