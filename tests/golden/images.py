"""Draw the golden images; ``python -m tests.golden.images`` rewrites those that are kept.

One PNG a task: a row for each look, a column for each camera.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import mujoco
import numpy as np
from PIL import Image

import pixelbrax_jax as pb
from pixelbrax_jax.tasks import BRAX_TASKS

FOLDER = Path(__file__).parent
LOOKS = ("default", "original")
SIZE = 48
"""Pixels of an image, each way."""


def draw(task: str) -> np.ndarray:
    """Draw a task from all its cameras in all looks, in a pose that MuJoCo computes.

    Returns:
        (48 looks, 48 cameras, 3) uint8.
    """
    env, params = pb.make(task, obs_mode="state")
    model = env.physics._model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0 + 0.2 * np.sin(1.0 + np.arange(model.nq))
    mujoco.mj_kinematics(model, data)
    xpos, xquat = data.xpos[1:].astype(np.float32), data.xquat[1:].astype(np.float32)

    @jax.jit
    def image(rig: pb.CameraRig, look: pb.Look) -> jax.Array:
        frame = pb.render(pb.place(params.geoms, rig, look, xpos, xquat), SIZE, SIZE)
        return jax.numpy.stack([frame.r, frame.g, frame.b], axis=-1)

    rows = [
        np.concatenate([image(rig, look) for rig in pb.named_rigs(task).values()], axis=1)
        for look in map(pb.make_look, LOOKS)
    ]
    return np.round(255 * np.clip(np.concatenate(rows), 0, 1)).astype(np.uint8)


def kept(task: str) -> np.ndarray:
    """Return a task's images as they were last accepted."""
    return np.asarray(Image.open(FOLDER / f"{task}.png").convert("RGB"))


def main() -> None:
    """Rewrite the images of some tasks, or of all."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("tasks", nargs="*", default=sorted(BRAX_TASKS), metavar="task")
    for task in parser.parse_args().tasks:
        Image.fromarray(draw(task)).save(FOLDER / f"{task}.png", optimize=True)


if __name__ == "__main__":
    main()
