"""Cameras of a MuJoCo model as camera rigs."""

from __future__ import annotations

import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.spatial import make_rig
from pixelbrax_jax.types import CameraRig

_TRACK = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
_TRACKCOM = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
_FIXED = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
_PERSPECTIVE = int(mujoco.mjtProjection.mjPROJ_PERSPECTIVE)


def tracked_body(model: mujoco.MjModel) -> int:
    """Return the body of the first camera, else lamp, of mode trackcom; -1 for none.

    Cameras and lamps of that mode follow the center of mass of its subtree, if the subtrees of
    their own bodies have the same mass.
    """
    modes = np.concatenate([model.cam_mode, model.light_mode])
    bodies = np.concatenate([model.cam_bodyid, model.light_bodyid])
    return next(map(int, bodies[modes == _TRACKCOM]), -1)


def follows_tracked(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body's subtree has the same mass as that of the tracked body."""
    mass = model.body_subtreemass
    return bool(np.isclose(mass[body], mass[tracked_body(model)], rtol=1e-6))


def followed_body(model: mujoco.MjModel) -> int:
    """Return the body that a view follows by default.

    It is the first moving one of the first tree with an actuator (not a goal), else of all, else 0.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    driven = {int(model.dof_treeid[dof]) for dof in data.moment_colind[: data.moment_rownnz.sum()]}
    moving = [body for body in range(1, model.nbody) if model.body_treeid[body] >= 0]
    robot = [body for body in moving if model.body_treeid[body] in driven]
    return (robot or moving or [0])[0]


def read_rigs(model: mujoco.MjModel, com_link: int) -> tuple[dict[str, CameraRig], dict[str, str]]:
    """Return rigs of a model's cameras by name, and the reasons why the others cannot be rigs.

    ``com_link`` is the link at the tracked center of mass, -1 for none. A rig's target lies on the
    camera's axis, at the depth of the tracked point or of the model's center of mass: camera
    distractors turn about it.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rigs, unfit = {}, {}
    for camera in range(model.ncam):
        name = camera_name(model, camera)
        if reason := _why_unfit(model, camera):
            unfit[name] = reason
            continue
        mode, body = int(model.cam_mode[camera]), int(model.cam_bodyid[camera])
        if mode == _TRACK and body:
            link, subject = body - 1, np.zeros(3)
            eye, axes = model.cam_pos0[camera], model.cam_mat0[camera]
        elif mode == _TRACKCOM:
            link, subject = com_link, np.zeros(3)
            eye, axes = model.cam_poscom0[camera], model.cam_mat0[camera]
        else:
            link, subject = -1, data.subtree_com[0]
            eye, axes = data.cam_xpos[camera], data.cam_xmat[camera]
        axes = axes.reshape(3, 3)
        forward, up, fovy = -axes[:, 2], axes[:, 1], float(model.cam_fovy[camera])
        depth = float((subject - eye) @ forward)
        # A camera that looks away from the subject also needs a target.
        target = eye + (depth if depth > 1e-3 else 1.0) * forward
        rigs[name] = make_rig(eye, target, fovy, link=link, track=(1.0, 1.0, 1.0), up=up)
    return rigs, unfit


def _why_unfit(model: mujoco.MjModel, camera: int) -> str:
    mode, body = int(model.cam_mode[camera]), int(model.cam_bodyid[camera])
    if model.cam_projection[camera] != _PERSPECTIVE:
        return "it has no perspective"
    if model.cam_sensorsize[camera].any() and model.cam_intrinsic[camera, 2:].any():
        return "its principal point is not the middle of its image"
    if mode == _FIXED and model.body_weldid[body] != 0:
        return f"it turns with body {model.body(body).name or body!r}"
    if mode == _TRACKCOM and not follows_tracked(model, body):
        return "it follows another center of mass than the first such camera does"
    if mode not in (_FIXED, _TRACK, _TRACKCOM):
        target = int(model.cam_targetbodyid[camera])
        return f"it turns towards body {model.body(target).name or target!r}"
    return ""


def camera_name(model: mujoco.MjModel, camera: int) -> str:
    """Return a camera's name, ``camera/<index>`` without one."""
    return model.camera(camera).name or f"camera/{camera}"
