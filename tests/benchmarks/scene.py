"""A task's model with our camera, for other renderers."""

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
    """The model that Brax loads, with our camera at the start of an episode as its only one.

    Returns:
        ``xml``, MJCF; ``qpos``, the joints' positions then.
    """
    file = Path(brax.envs.__file__).parent / "assets" / f"{_FILES.get(task, task)}.xml"
    env, params = pb.make(task)
    state, _ = env.reset(jax.random.key(0), params)
    physics = state.sim.physics
    scene = place(params.geoms, params.rig, params.look, physics.xpos, physics.xquat)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(scene.camera.xmat, np.float64).ravel())
    spec = mujoco.MjSpec.from_file(str(file))
    for camera in list(spec.cameras):
        spec.delete(camera)
    spec.worldbody.add_camera(
        name="pixelbrax",
        pos=np.asarray(scene.camera.pos),
        quat=quat,
        fovy=float(scene.camera.fovy),
    )
    spec.compile()
    return {"xml": spec.to_xml(), "qpos": np.asarray(physics.engine.pipeline.q).tolist()}


_FILES = {"halfcheetah": "half_cheetah"}
