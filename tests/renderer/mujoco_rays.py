"""MuJoCo's own ray caster as an independent renderer of geom ids and depths."""

from __future__ import annotations

import mujoco
import numpy as np

from pixelbrax_jax.types import Scene


def cast_rays(
    model: mujoco.MjModel, data: mujoco.MjData, eye, axes, fovy: float, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """The geoms of a model that the pixels of a camera see, one `mj_ray` each.

    `mj_multiRay` is not used: that of MuJoCo 4.0.0 disagrees with its own `mj_ray`.

    Returns:
        (H, W) int, geom or -1; (H, W) depth along the viewing axis.
    """
    eye, axes = np.asarray(eye, np.float64), np.asarray(axes, np.float64)
    half = np.tan(np.deg2rad(float(fovy)) / 2)
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
                seg[row, column] = hit[0]
                depth[row, column] = t / length
    return seg, depth


def cast(
    model: mujoco.MjModel, scene: Scene, shown: list[int], height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Index into the scene's geoms or -1, and depth, (H, W) each.

    Args:
        model: a model with the scene's geoms; its poses are replaced by the scene's.
        scene: the scene, unbatched.
        shown: the model's index of each geom of the scene.
        height: pixels.
        width: pixels.
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
    camera = scene.camera
    seen, depth = cast_rays(model, data, camera.pos, camera.xmat, camera.fovy, height, width)
    index_of = np.full(model.ngeom + 1, -1)  # the last one is the sky's
    index_of[shown] = np.arange(len(shown))
    return index_of[seen], depth
