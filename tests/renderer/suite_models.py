"""Models of the DM Control Suite in random poses, by MuJoCo alone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco.scene import ModelScene, read_scene, tracked_body
from pixelbrax_jax.scene.cameras import seen_from

MODELS = {
    "acrobot": ("swingup", 0, ()),
    "ball_in_cup": ("catch", 0, ()),
    "cartpole": ("swingup", 0, ()),
    "cheetah": ("run", 0, ()),
    "finger": ("turn_easy", 0, ("target",)),
    "fish": ("swim", 0, ("target",)),
    "hopper": ("hop", 0, ()),
    "humanoid": ("walk", 0, ()),
    "manipulator": ("bring_ball", 0, ()),
    "pendulum": ("swingup", 0, ()),
    "point_mass": ("easy", 0, ()),
    "quadruped": ("walk", 2, ()),
    "reacher": ("easy", 0, ("target",)),
    "swimmer": ("swimmer6", 0, ("target", "target_light")),
    "walker": ("walk", 0, ()),
}
"""Domain -> a task, the camera that papers use, and what moves by an edit of the model."""


@dataclass
class Suite:
    """A model of the suite, what we read of it, and poses of it."""

    domain: str
    model: mujoco.MjModel
    camera: int
    scene: ModelScene
    movable: tuple[str, ...]
    data: mujoco.MjData = field(init=False)

    def __post_init__(self) -> None:
        self.data = mujoco.MjData(self.model)

    def poses(self, number: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Put the model in random poses, one after the other, by MuJoCo's kinematics.

        Yields:
            (L, 3) positions and (L, 4) orientations of the links, float32.
        """
        rng = np.random.default_rng(0)
        model, data = self.model, self.data
        for _ in range(number):
            data.qpos[:] = model.qpos0 + rng.uniform(-0.4, 0.4, model.nq)
            mujoco.mj_normalizeQuat(model, data.qpos)
            if self.movable:
                self._move(rng.uniform(-0.15, 0.15, 3) * [1.0, float(self.domain != "finger"), 0.3])
            mujoco.mj_forward(model, data)
            yield self.links()

    def _move(self, by: np.ndarray) -> None:
        for name in self.movable:
            for elements, pos in (
                (self._names("geom"), self.model.geom_pos),
                (self._names("site"), self.model.site_pos),
                (self._names("light"), self.model.light_pos),
            ):
                if name in elements:
                    pos[elements.index(name)] += by

    def _names(self, kind: str) -> list[str]:
        return [getattr(self.model, kind)(i).name for i in range(getattr(self.model, f"n{kind}"))]

    def links(self, data: mujoco.MjData | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the links, of our own data unless others are given."""
        data, extra = data or self.data, []
        for name in self.scene.links:
            if name == "camera/com":
                extra.append(data.subtree_com[tracked_body(self.model)])
            elif "target" in self._names("geom"):
                extra.append(data.geom("target").xpos)
            else:
                extra.append(data.site("target").xpos)
        xpos = np.concatenate([data.xpos[1:], *[row[None] for row in extra]])
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(extra), 1))
        xquat = np.concatenate([data.xquat[1:], upright])
        return xpos.astype(np.float32), xquat.astype(np.float32)


def load(domain: str) -> Suite:
    """Load a model with the suite's own code; skip the test where the suite is not installed."""
    os.environ.setdefault("MUJOCO_GL", "disable")
    suite = pytest.importorskip("dm_control.suite")
    task, camera, movable = MODELS[domain]
    environment = suite.load(domain, task, task_kwargs={"random": 0})
    environment.reset()  # targets get their sizes here
    return of(domain, environment.physics.model.ptr, camera, movable)


def of(domain: str, model: mujoco.MjModel, camera: int, movable: tuple[str, ...]) -> Suite:
    """Read a model as it is now."""
    scene = read_scene(model, camera, movable=movable)
    scene = scene._replace(geoms=seen_from(scene.geoms, scene.rig))
    return Suite(domain, model, camera, scene, movable)
