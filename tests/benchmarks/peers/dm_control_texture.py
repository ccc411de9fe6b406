"""What a video background costs in DM Control, where each step uploads a texture.

The Distracting Control Suite (arXiv 2101.02722) writes each video frame into the skybox texture
and uploads it to OpenGL. This measures DM Control's pixels with and without such an upload, in the
environment that the benchmark makes for it:

    python -m tests.benchmarks.run --only peers --task halfcheetah
    MUJOCO_GL=osmesa .venv-peers/dm_control/bin/python tests/benchmarks/peers/dm_control_texture.py

It needs an OpenGL library, e.g. Debian's libosmesa6.
"""

from __future__ import annotations

import argparse
import json
import time
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
from dm_control import suite

TASKS = (("cheetah", "run"), ("walker", "walk"))
REPETITIONS, STEPS = 5, 60
SIZE = 84


def steps_per_second(domain: str, task: str, *, upload: bool) -> float:
    """Median over repetitions, one environment, one image a step."""
    env = suite.load(domain, task, task_kwargs={"random": 0})
    env.reset()
    physics, spec = env.physics, env.action_spec()
    model, rng = physics.model, np.random.default_rng(0)
    kinds = list(model.tex_type)
    sky = kinds.index(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    size = int(model.tex_height[sky] * model.tex_width[sky] * model.tex_nchannel[sky])
    first = int(model.tex_adr[sky])
    video = rng.integers(0, 256, (8, size), dtype=np.uint8)
    physics.render(SIZE, SIZE, camera_id=0)
    speeds = []
    for _ in range(REPETITIONS):
        started = time.perf_counter()
        for step in range(STEPS):
            if env.step(rng.uniform(spec.minimum, spec.maximum)).last():
                env.reset()
            if upload:
                model.tex_data[first : first + size] = video[step % len(video)]
                with physics.contexts.gl.make_current() as context:
                    context.call(
                        mujoco.mjr_uploadTexture, model.ptr, physics.contexts.mujoco.ptr, sky
                    )
            physics.render(SIZE, SIZE, camera_id=0)
        speeds.append(STEPS / (time.perf_counter() - started))
    physics.free()
    return float(np.median(speeds))


def main() -> None:
    """Measures and writes ``dm_control_texture.json``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output-dir", type=Path, default=Path("docs/benchmarks"))
    options = parser.parse_args()
    report = {"versions": {name: version(name) for name in ("dm_control", "mujoco")}}
    for domain, task in TASKS:
        plain = steps_per_second(domain, task, upload=False)
        uploading = steps_per_second(domain, task, upload=True)
        report[domain] = {
            "steps_per_second": plain,
            "steps_per_second_with_upload": uploading,
            "ratio": uploading / plain,
        }
        print(json.dumps({domain: report[domain]}))
    options.output_dir.mkdir(parents=True, exist_ok=True)
    file = options.output_dir / "dm_control_texture.json"
    file.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
