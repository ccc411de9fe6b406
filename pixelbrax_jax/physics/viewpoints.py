"""Cameras of a MuJoCo model, as camera rigs."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from pixelbrax_jax.types import CameraRig

_TRACK = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
_TRACKCOM = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
_FIXED = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)


def tracked_body(model: mujoco.MjModel) -> int:
    """Return the body whose subtree's center of mass cameras and lamps of mode trackcom follow.

    Returns:
        That of the first such camera or else lamp; -1 if there is none. Others follow it if their
        subtrees have the same mass, which a model's one robot sees to.
    """
    for modes, bodies in (
        (model.cam_mode, model.cam_bodyid),
        (model.light_mode, model.light_bodyid),
    ):
        for mode, body in zip(modes, bodies, strict=True):
            if mode == _TRACKCOM:
                return int(body)
    return -1


def follows_tracked(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body's subtree has the center of mass of the tracked one's."""
    mass = model.body_subtreemass
    return bool(np.isclose(mass[body], mass[tracked_body(model)], rtol=1e-6))


def read_rigs(model: mujoco.MjModel, com_link: int) -> dict[str, CameraRig]:
    """Return rigs of a model's cameras that keep their orientation.

    Cameras at rest and those of MuJoCo's modes track and trackcom are; cameras that turn with a
    body or towards one are left out. A rig's target is on the camera's axis as deep as what it
    shows, the tracked point or the model's center of mass, so that a camera distractor turns about
    that.

    Args:
        model: the compiled model; link i is its body i + 1.
        com_link: index of the link at the tracked center of mass, -1 if there is none.

    Returns:
        Rigs by the camera's name, ``camera/<index>`` where it has none, in the model's order.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rigs = {}
    for camera in range(model.ncam):
        mode, body = int(model.cam_mode[camera]), int(model.cam_bodyid[camera])
        if mode == _TRACK and body:
            link, subject = body - 1, np.zeros(3)
            eye, axes = model.cam_pos0[camera], model.cam_mat0[camera]
        elif mode == _TRACKCOM and follows_tracked(model, body):
            link, subject = com_link, np.zeros(3)
            eye, axes = model.cam_poscom0[camera], model.cam_mat0[camera]
        elif mode in (_FIXED, _TRACK) and model.body_weldid[body] == 0:
            link, subject = -1, data.subtree_com[0]
            eye, axes = data.cam_xpos[camera], data.cam_xmat[camera]
        else:
            continue
        name = model.camera(camera).name or f"camera/{camera}"
        rigs[name] = _rig(link, eye, axes.reshape(3, 3), subject, float(model.cam_fovy[camera]))
    return rigs


def _rig(
    link: int, eye: np.ndarray, axes: np.ndarray, subject: np.ndarray, fovy: float
) -> CameraRig:
    forward = -axes[:, 2]
    depth = float((subject - eye) @ forward)
    return CameraRig(
        link=link,
        track=_f32([float(link >= 0)] * 3),
        eye=_f32(eye),
        # A camera that looks away from the subject still needs a point to look at.
        target=_f32(eye + (depth if depth > 1e-3 else 1.0) * forward),
        up=_f32(axes[:, 1]),
        fovy=_f32(fovy),
    )


def _f32(values: Any) -> Any:
    return np.asarray(values, np.float32)
