"""MuJoCo's own ray caster as an independent renderer of geom ids and depths."""

from __future__ import annotations

import mujoco
import numpy as np

from pixelbrax_jax.types import Scene


def cast(
    model: mujoco.MjModel, scene: Scene, shown: list[int], height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Geom index and depth a pixel, one `mj_ray` each.

    `mj_multiRay` is not used: that of MuJoCo 4.0.0 disagrees with its own `mj_ray`.

    Args:
        model: a model with the scene's geoms; its poses are replaced by the scene's.
        scene: the scene, unbatched.
        shown: the model's index of each geom of the scene.
        height: pixels.
        width: pixels.

    Returns:
        (H, W) int, index into the scene's geoms or -1; (H, W) depth along the viewing axis.
    """
    # MuJoCo ends a plane at its size, we do not; size 0 stands for no bounds.
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[planes, :2] = 0.0
    model.geom_rgba[:, 3] = 0.0  # invisible to mj_ray ...
    model.geom_matid[:] = -1
    model.geom_rgba[shown, 3] = 1.0  # ... but for those in the scene
    data = mujoco.MjData(model)
    data.geom_xpos[shown] = np.asarray(scene.pos)
    data.geom_xmat[shown] = np.asarray(scene.xmat).reshape(-1, 9)
    model.geom_size[shown] = np.where(
        planes[shown][:, None], model.geom_size[shown], np.asarray(scene.geoms.size)
    )
    index_of = {model_id: g for g, model_id in enumerate(shown)}

    eye = np.asarray(scene.camera.pos, np.float64)
    axes = np.asarray(scene.camera.xmat, np.float64)
    half = np.tan(np.deg2rad(float(scene.camera.fovy)) / 2)
    seg = np.full((height, width), -1)
    depth = np.full((height, width), np.inf)
    hit = np.zeros(1, np.int32)
    for row in range(height):
        for column in range(width):
            x = (2 * column + 1 - width) / height * half
            y = (height - 1 - 2 * row) / height * half
            ray = axes @ np.array([x, y, -1.0])
            length = np.linalg.norm(ray)
            t = mujoco.mj_ray(model, data, eye, ray / length, None, 1, -1, hit)
            if t >= 0:
                seg[row, column] = index_of[int(hit[0])]
                depth[row, column] = t / length
    return seg, depth
