"""Compares pictures of the DM Control Suite's models with those of the suite itself.

    MUJOCO_GL=egl python -m tests.benchmarks.suite_pictures

draws both with the same states, 84 x 84 pixels and each task's usual camera, and writes
docs/images/dmc/beside.png, the suite's on the left, and docs/dmc/pictures.json: mean absolute
differences of color in units of 1/255, of all pixels, of the sky, the ground and all else. With
``--samples 4`` it writes docs/dmc/pictures-4.json alone. It needs the package ``dm_control`` and a
library of EGL (Debian's ``libegl1``); ``MUJOCO_GL=osmesa`` draws the same with ``libosmesa6``.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import jax
import mujoco
import numpy as np
from PIL import Image, ImageDraw

from pixelbrax_jax.physics.mujoco.lighting import detailed
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.types import Frame
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


def pictures(
    domain: str, task: str, camera: int, movable: tuple[str, ...], samples: int = 1
) -> dict[str, list]:
    """Draw states of an episode of random actions.

    Returns:
        Lists of ``theirs`` and ``ours``, (84, 84, 3) uint8, and of ``area``, (84, 84) int: 0 sky,
        1 ground, 2 else.
    """
    from dm_control import suite

    environment = suite.load(domain, task, task_kwargs={"random": 1})
    environment.reset()
    physics, rng = environment.physics, np.random.default_rng(1)
    own = suite_models.of(domain, physics.model.ptr, camera, movable)
    scene = own.scene
    pixel = 2.0 * float(np.tan(np.deg2rad(scene.rig.fovy) / 2.0)) / (SIZE * math.isqrt(samples))
    look = detailed(own.model, scene.look, pixel)

    @jax.jit
    def draw(xpos: jax.Array, xquat: jax.Array) -> Frame:
        placed = place(scene.geoms, scene.rig, look, xpos, xquat)
        return render(placed, SIZE, SIZE, samples=samples)

    drawn: dict[str, list] = {"theirs": [], "ours": [], "area": []}
    for state in range(STATES):
        if state:
            for _ in range(20):
                environment.step(rng.uniform(-1, 1, environment.action_spec().shape))
        mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
        frame = draw(*own.links(physics.data.ptr))
        image = np.stack([frame.r, frame.g, frame.b], axis=-1)
        drawn["ours"].append(np.floor(image * 255 + 0.5).astype(np.uint8))
        drawn["theirs"].append(physics.render(SIZE, SIZE, camera_id=camera))
        seen, ground = np.asarray(frame.seg) >= 0, np.asarray(frame.ground)
        drawn["area"].append(np.where(ground, 1, np.where(seen, 2, 0)))
    environment.close()
    return drawn


def differences(drawn: dict[str, list]) -> dict[str, float | None]:
    """Return mean absolute differences by area, in units of 1/255; None where there is none."""
    ours, theirs = (np.stack(drawn[side]).astype(int) for side in ("ours", "theirs"))
    difference, area = np.abs(ours - theirs).mean(axis=-1), np.stack(drawn["area"])
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
    parser.add_argument("--samples", type=int, default=1, help="rays per pixel")
    options = parser.parse_args()
    chosen = options.cases
    report, pairs = {}, {}
    for name in chosen:
        drawn = pictures(*CASES[name], options.samples)
        report[name] = differences(drawn)
        print(f"{name:24} {report[name]}", flush=True)
        gap = np.full((SIZE, 2, 3), 255, np.uint8)
        pairs[name] = np.concatenate([drawn["theirs"][1], gap, drawn["ours"][1]], axis=1)
    if set(chosen) == set(CASES):
        (DOCS / "dmc").mkdir(exist_ok=True)
        command, stem = "MUJOCO_GL=egl python -m tests.benchmarks.suite_pictures", "pictures"
        if supersampled := options.samples > 1:
            command += f" --samples {options.samples}"
            stem += f"-{options.samples}"
        kept = {
            "command": command,
            "mujoco": mujoco.__version__,
            "pixels": SIZE,
            "states": STATES,
            "samples": options.samples,
            "mean_absolute_difference_of_255": report,
        }
        text = json.dumps(kept, indent=2) + "\n"
        (DOCS / "dmc" / f"{stem}.json").write_text(text, "utf-8")
        if not supersampled:
            (DOCS / "images" / "dmc").mkdir(parents=True, exist_ok=True)
            sheet(pairs).save(DOCS / "images" / "dmc" / "beside.png", optimize=True)
    else:
        sheet(pairs).save("beside.png")


if __name__ == "__main__":
    main()
