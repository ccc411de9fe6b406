"""What MuJoCo's own visualizer shows, as targets for its ray caster."""

from __future__ import annotations

import mujoco
import numpy as np

from tests.renderer.mujoco_rays import cast_rays


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
    seg, depth = cast_rays(targets, posed, eye, axes, model.cam_fovy[camera], size, size)
    return np.array([*(name for name, _ in shown), ""], dtype=object)[seg], depth


ROUND = ("capsule", "cylinder")
