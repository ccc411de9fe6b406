"""Compares pictures of the DM Control Suite's models with those of the suite itself.

    MUJOCO_GL=egl python -m tests.benchmarks.suite_pictures

draws both with the same states, 84 x 84 pixels and each task's usual camera, and writes
docs/images/dmc/beside.png, the suite's on the left, and docs/dmc/pictures.json: mean absolute
differences of color in units of 1/255, of all pixels, of the sky, the ground and all else, for the
``COMPARED`` pairs of pictures. It needs the package ``dm_control`` and a library of EGL (Debian's
``libegl1``); ``MUJOCO_GL=osmesa`` draws the same with ``libosmesa6``.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from PIL import Image, ImageDraw

from pixelbrax_jax.physics.mujoco.lighting import detailed
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.types import Frame, Look
from tests.renderer import suite_models

DOCS = Path(__file__).parents[2] / "docs"
SIZE = 84
STATES = 5
"""States that are compared, 20 random actions apart; the sheet shows the second."""
COLUMNS, CAPTION = 3, 14

CASES = {
    **{domain: (domain, *row) for domain, row in suite_models.MODELS.items()},
    "finger spin": ("finger", "spin", 0, ()),
    "fish upright": ("fish", "upright", 0, ()),
    "swimmer15": ("swimmer", "swimmer15", 0, ("target", "target_light")),
    "quadruped from camera 0": ("quadruped", "walk", 0, ()),
}
"""What is shown: domain, task, camera, and what moves by an edit of the model."""


COMPARED = {
    "ours, theirs": "here and in the suite, whose OpenGL multisamples (4 samples)",
    "ours, single": "here and in OpenGL without multisampling",
    "ours with 4 rays, theirs": "here with samples=4 and in the suite",
    "single, theirs": "OpenGL without and with multisampling",
    "picked, theirs": "OpenGL without multisampling at its own sample positions, and with it",
}
SUPERSAMPLED = 4
POSITIONS = ((2, 0), (0, 1), (3, 2), (1, 3))
"""OpenGL's four sample positions in a pixel, (x, y) from its top left corner in quarters of it."""


def pictures(domain: str, task: str, camera: int, movable: tuple[str, ...]) -> dict[str, list]:
    """Draw states of an episode of random actions.

    Returns:
        Lists of the pictures in ``COMPARED``, (84, 84, 3) float or uint8, and of ``area``,
        (84, 84) int: 0 sky, 1 ground, 2 else.
    """
    drawn = ours(domain, task, camera, movable)
    large = theirs(domain, task, camera, SUPERSAMPLED * SIZE, multisamples=0)
    return {
        "ours": [levels(frame) for frame in drawn],
        "ours with 4 rays": [levels(f) for f in ours(domain, task, camera, movable, samples=4)],
        "area": [area(frame) for frame in drawn],
        "theirs": theirs(domain, task, camera, SIZE),
        "single": theirs(domain, task, camera, SIZE, multisamples=0),
        "picked": [
            np.mean([image[y::SUPERSAMPLED, x::SUPERSAMPLED] for x, y in POSITIONS], axis=0)
            for image in large
        ],
    }


def _states(domain: str, task: str, multisamples: int | None = None) -> Iterator[Any]:
    """Yield dm_control's physics in each of the states."""
    from dm_control import suite

    environment = suite.load(domain, task, task_kwargs={"random": 1})
    physics, rng = environment.physics, np.random.default_rng(1)
    if multisamples is not None:
        physics.model.vis.quality.offsamples = multisamples
    environment.reset()
    for state in range(STATES):
        if state:
            for _ in range(20):
                environment.step(rng.uniform(-1, 1, environment.action_spec().shape))
        mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
        yield physics
    environment.close()


def theirs(
    domain: str, task: str, camera: int, size: int, multisamples: int | None = None
) -> list[np.ndarray]:
    """Draw the states with dm_control, (size, size, 3) uint8 each."""
    states = _states(domain, task, multisamples)
    return [physics.render(size, size, camera_id=camera) for physics in states]


def ours(
    domain: str,
    task: str,
    camera: int,
    movable: tuple[str, ...],
    samples: int = 1,
    look_of: Callable[[Look, Look], Look] = lambda whole, plain: whole,
) -> list[Frame]:
    """Draw the states with the look that is chosen from the whole picture's and the plain one."""
    states = _states(domain, task)
    first = next(states)
    own = suite_models.of(domain, first.model.ptr, camera, movable)
    draw = jax.jit(partial(_render, own, samples, look_of))
    return [draw(*own.links(physics.data.ptr)) for physics in chain([first], states)]


def levels(frame: Frame) -> np.ndarray:
    """Return (84, 84, 3) uint8."""
    image = np.stack([frame.r, frame.g, frame.b], axis=-1)
    return np.floor(image * 255 + 0.5).astype(np.uint8)


def area(frame: Frame) -> np.ndarray:
    """Return (84, 84) int: 0 sky, 1 ground, 2 else."""
    seen, ground = np.asarray(frame.seg) >= 0, np.asarray(frame.ground)
    return np.where(ground, 1, np.where(seen, 2, 0))


def _render(
    own: Any,
    samples: int,
    look_of: Callable[[Look, Look], Look],
    xpos: jax.Array,
    xquat: jax.Array,
) -> Frame:
    scene = own.scene
    pixel = 2.0 * float(np.tan(np.deg2rad(scene.rig.fovy) / 2.0)) / (SIZE * math.isqrt(samples))
    look = look_of(detailed(own.model, scene.look, pixel), scene.look)
    placed = place(scene.geoms, scene.rig, look, xpos, xquat)
    return render(placed, SIZE, SIZE, samples=samples)


def differences(drawn: dict[str, list], pair: str) -> dict[str, float | None]:
    """Return mean absolute differences by area, in units of 1/255; None where there is none."""
    one, other = (np.stack(drawn[name]).astype(float) for name in pair.split(", "))
    difference, area = np.abs(one - other).mean(axis=-1), np.stack(drawn["area"])
    masks = {"all": area >= 0, "sky": area == 0, "ground": area == 1, "else": area == 2}
    return {
        name: round(float(difference[mask].mean()), 2) if mask.any() else None
        for name, mask in masks.items()
    }


def sheet(pairs: dict[str, np.ndarray], scale: int = 2) -> Image.Image:
    """Return pairs of pictures, (84, 168, 3) uint8 each, under their names."""
    width, height = (2 * SIZE + 2) * scale, SIZE * scale + CAPTION
    rows = -(-len(pairs) // COLUMNS)
    page = Image.new("RGB", (COLUMNS * (width + 8) - 8, rows * (height + 6)), "white")
    pen = ImageDraw.Draw(page)
    for k, (name, pair) in enumerate(pairs.items()):
        left, top = k % COLUMNS * (width + 8), k // COLUMNS * (height + 6)
        pen.text((left, top), name, fill="black")
        big = Image.fromarray(pair).resize((width, SIZE * scale), Image.Resampling.NEAREST)
        page.paste(big, (left, top + CAPTION))
    return page


def main() -> None:
    """Compare some models, or all; files are written for all."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), metavar="case")
    chosen = parser.parse_args().cases
    report: dict[str, dict] = {pair: {} for pair in COMPARED}
    pairs = {}
    for name in chosen:
        drawn = pictures(*CASES[name])
        for pair, rows in report.items():
            rows[name] = differences(drawn, pair)
            print(f"{name:24} {pair:24} {rows[name]}", flush=True)
        gap = np.full((SIZE, 2, 3), 255, np.uint8)
        pairs[name] = np.concatenate([drawn["theirs"][1], gap, drawn["ours"][1]], axis=1)
    if set(chosen) == set(CASES):
        (DOCS / "dmc").mkdir(exist_ok=True)
        kept = {
            "command": "MUJOCO_GL=egl python -m tests.benchmarks.suite_pictures",
            "mujoco": mujoco.__version__,
            "pixels": SIZE,
            "states": STATES,
            "compared": COMPARED,
            "mean_absolute_difference_of_255": report,
        }
        text = json.dumps(kept, indent=2) + "\n"
        (DOCS / "dmc" / "pictures.json").write_text(text, "utf-8")
        (DOCS / "images" / "dmc").mkdir(parents=True, exist_ok=True)
        sheet(pairs).save(DOCS / "images" / "dmc" / "beside.png", optimize=True)
    else:
        Path("runs").mkdir(exist_ok=True)
        sheet(pairs).save("runs/beside.png")


if __name__ == "__main__":
    main()
