"""What MuJoCo's own visualizer shows, as targets for its ray caster."""

from __future__ import annotations

import mujoco
import numpy as np


def shown_geoms(
    model: mujoco.MjModel, data: mujoco.MjData, camera: int
) -> list[tuple[str, object]]:
    """Names and abstract geoms of everything that MuJoCo shows by default."""
    scene, view = mujoco.MjvScene(model, 2000), mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, everything, scene)
    names = {
        int(mujoco.mjtObj.mjOBJ_GEOM): lambda i: (
            model.geom(i).name or f"{kind_name(model.geom_type[i])}/{i}"
        ),
        int(mujoco.mjtObj.mjOBJ_SITE): lambda i: f"site/{model.site(i).name or i}",
        int(mujoco.mjtObj.mjOBJ_TENDON): lambda i: f"tendon/{model.tendon(i).name}",
    }
    return [(names[g.objtype](g.objid), g) for g in scene.geoms[: scene.ngeom]]


def kind_name(kind: int) -> str:
    """MuJoCo's name of a geom type."""
    return mujoco.mjtGeom(int(kind)).name.removeprefix("mjGEOM_").lower()


def cast(
    model: mujoco.MjModel, data: mujoco.MjData, camera: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Show a model with ``mj_ray``, one ray a pixel, through one of its cameras.

    Returns:
        (size, size) str, name of what is seen, ``""`` for the sky; (size, size) depth, metres.
    """
    shown = shown_geoms(model, data, camera)
    spec = mujoco.MjSpec()
    for _, geom in shown:
        kind = mujoco.mjtGeom(int(geom.type))
        # The visualizer has a capsule's half length last, and three radii of a sphere.
        half = [geom.size[0], geom.size[2], 0.0] if kind_name(kind) in ROUND else geom.size
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.asarray(geom.mat, np.float64).ravel())
        spec.worldbody.add_geom(
            type=kind, size=np.asarray(half, np.float64), pos=geom.pos, quat=quat
        )
    targets = spec.compile()
    posed = mujoco.MjData(targets)
    mujoco.mj_kinematics(targets, posed)

    eye, axes = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
    half = np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
    seen = np.full((size, size), "", dtype=object)
    depth = np.full((size, size), np.inf)
    hit = np.zeros(1, np.int32)
    for row in range(size):
        for column in range(size):
            x, y = (2 * column + 1 - size) / size * half, (size - 1 - 2 * row) / size * half
            ray = axes @ np.array([x, y, -1.0])
            length = np.linalg.norm(ray)
            t = mujoco.mj_ray(targets, posed, eye, ray / length, None, 1, -1, hit)
            if t >= 0:
                seen[row, column] = shown[int(hit[0])][0]
                depth[row, column] = t / length
    return seen, depth


ROUND = ("capsule", "cylinder")
