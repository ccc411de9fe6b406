"""Provisional."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from pixelbrax_jax.physics.geometry import read_geoms
from pixelbrax_jax.types import CameraRig


class ModelScene(NamedTuple):
    """Provisional."""

    geoms: Any
    rig: Any
    rigs: Any
    look: Any
    links: tuple[str, ...]


def read_scene(model: mujoco.MjModel, camera: int = 0, *, movable: tuple[str, ...] = ()) -> ModelScene:
    """Provisional."""
    geoms = read_geoms(model)
    f = lambda v: np.asarray(v, np.float32)  # noqa: E731
    rig = CameraRig(link=-1, track=f([0, 0, 0]), eye=f([0, -3, 1]), target=f([0, 0, 1]), up=f([0, 0, 1]), fovy=f(45))
    links = ("camera/com",) if model.cam_mode[camera] == 2 else ()
    return ModelScene(geoms, rig, {"default": rig}, None, links + (("target",) if movable else ()))


def tracked_body(model: mujoco.MjModel) -> int:
    """Provisional."""
    return int(model.cam_bodyid[0])
