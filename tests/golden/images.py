"""Draw the golden images; ``python -m tests.golden.images`` rewrites those that are kept.

One PNG for each of Brax's tasks: a row for each look, a column for each camera. One PNG for each
model of the DM Control Suite and of Gymnasium: its task's own camera, of DM Control in both looks.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import mujoco
import numpy as np
from PIL import Image

import pixelbrax_jax as pb
from pixelbrax_jax.physics.mujoco.scene import COM_LINK, tracked_body
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.tasks import BRAX_TASKS, DMC_TASKS, GYM_TASKS

FOLDER = Path(__file__).parent
LOOKS = {"brax": ("default", "original"), "dmc": ("default", "dmc"), "gym": ("default",)}
SIZE = {"brax": 48, "dmc": 84, "gym": 84}
"""Pixels of an image, each way."""
TARGET = (0.1, -0.05, 0.1)
"""Metres, where the target is in tasks that have one."""

DMC_MODELS = {
    **{row.domain: name for name, row in reversed(DMC_TASKS.items())},
    "swimmer15": "dmc_swimmer_swimmer15",
}
"""A task of each model."""
TASKS = (*BRAX_TASKS, *DMC_MODELS.values(), *GYM_TASKS)


def suite_of(task: str) -> str:
    return "brax" if task in BRAX_TASKS else "dmc" if task in DMC_TASKS else "gym"


def draw(task: str, *looks: str) -> np.ndarray:
    """Draw a task from its cameras in some or all of its looks, in a pose that MuJoCo computes.

    Returns:
        (size looks, size cameras, 3) uint8.
    """
    suite = suite_of(task)
    env, params = pb.make(task, obs_mode="state")
    rigs = list(pb.named_rigs(task).values()) if suite == "brax" else [params.rig]
    looks = looks or LOOKS[suite]
    worn = [pb.make(task, obs_mode="state", look=look)[1].look for look in looks]
    xpos, xquat = pose(env.physics)
    size = SIZE[suite]

    @jax.jit
    def image(rig: pb.CameraRig, look: pb.Look) -> jax.Array:
        frame = render(place(params.geoms, rig, look, xpos, xquat), size, size)
        return jax.numpy.stack([frame.r, frame.g, frame.b], axis=-1)

    rows = [np.concatenate([image(rig, look) for rig in rigs], axis=1) for look in worn]
    return np.round(255 * np.clip(np.concatenate(rows), 0, 1)).astype(np.uint8)


def pose(physics: pb.Physics) -> tuple[np.ndarray, np.ndarray]:
    """Return (L, 3) positions and (L, 4) orientations of the links, all joints bent a little."""
    model = physics._model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0 + 0.2 * np.sin(1.0 + np.arange(model.nq))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    xpos, xquat = [*data.xpos[1:]], [*data.xquat[1:]]
    for link in physics.link_names[model.nbody - 1 :]:
        com = data.subtree_com[tracked_body(physics._model)] if link == COM_LINK else TARGET
        xpos.append(np.asarray(com))
        xquat.append(np.asarray([1.0, 0, 0, 0]))
    return np.asarray(xpos, np.float32), np.asarray(xquat, np.float32)


def kept(task: str, look: str | None = None) -> np.ndarray:
    """Return a task's images as they were last accepted, of one look or of all."""
    images = np.asarray(Image.open(FOLDER / f"{task}.png").convert("RGB"))
    suite = suite_of(task)
    row = LOOKS[suite].index(look) if look else 0
    return images[row * SIZE[suite] :][: SIZE[suite]] if look else images


def main() -> None:
    """Rewrite the images of some tasks, or of all."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("tasks", nargs="*", default=TASKS, metavar="task")
    for task in parser.parse_args().tasks:
        Image.fromarray(draw(task)).save(FOLDER / f"{task}.png", optimize=True)


if __name__ == "__main__":
    main()
