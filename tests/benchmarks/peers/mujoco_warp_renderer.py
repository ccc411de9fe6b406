"""MuJoCo Warp's ray tracer on a task's own model, in the same pose and seen from our camera.

    python mujoco_warp_renderer.py '{"task": "ant", "num_envs": 256, "scene": {...}}'

``scene`` comes from ``tests.benchmarks.scene``. A frame costs the refit of the bounding volumes
and the picture; there are no textures and no shadows. Warp runs its kernels in one thread on a
CPU, so there is a process for each core, with ``num_envs`` worlds each, and their rates are summed.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import time
from typing import Any

import numpy as np

REPETITIONS, SECONDS, SIZE = 5, 2.0, 84


def prepare(scene: dict[str, Any], num_envs: int) -> Any:
    """A function that draws all worlds once, and the context that holds their pictures."""
    try:
        import mujoco
        import mujoco_warp as mjw
        import warp as wp
    except ImportError as error:
        print(f"its wheel does not run here: {error}", file=sys.stderr)
        sys.exit(3)

    spec = mujoco.MjSpec.from_string(scene["xml"])
    for camera in list(spec.cameras):
        spec.delete(camera)
    spec.worldbody.add_camera(
        name="pixelbrax", pos=scene["pos"], quat=scene["quat"], fovy=scene["fovy"]
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene["qpos"]
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=num_envs)
    context = mjw.create_render_context(
        model,
        nworld=num_envs,
        cam_res=(SIZE, SIZE),
        render_rgb=True,
        render_depth=False,
        use_textures=False,
        use_shadows=False,
    )

    def draw() -> None:
        mjw.refit_bvh(m, d, context)
        mjw.render(m, d, context)
        wp.synchronize()

    draw()
    return draw, context


def rates_of(scene: dict[str, Any], num_envs: int, ready: Any) -> list[float]:
    """Frames per second of each repetition, begun when all processes are ready."""
    draw, _ = prepare(scene, num_envs)
    ready.wait()
    rates = []
    for _ in range(REPETITIONS):
        frames, started = 0, time.perf_counter()
        while time.perf_counter() - started < SECONDS:
            draw()
            frames += num_envs
        rates.append(frames / (time.perf_counter() - started))
    return rates


def main() -> None:
    from importlib.metadata import version

    arguments = json.loads(sys.argv[1])
    scene, num_envs = arguments["scene"], arguments["num_envs"]
    started = time.perf_counter()
    _, context = prepare(scene, num_envs)
    compile_seconds = time.perf_counter() - started
    import warp

    on_cpu = warp.get_device().is_cpu
    processes = len(os.sched_getaffinity(0)) if on_cpu else 1
    spawn = multiprocessing.get_context("spawn")
    with spawn.Manager() as manager, spawn.Pool(processes) as pool:
        ready = manager.Barrier(processes)
        work = [(scene, num_envs, ready)] * processes
        rates = np.sum(pool.starmap(rates_of, work, chunksize=1), axis=0)
    values = {
        "frames_per_second": float(np.median(rates)),
        "speed": {
            "median": float(np.median(rates)),
            "slowest": float(rates.min()),
            "fastest": float(rates.max()),
        },
        "processes": processes,
        "compile_seconds": compile_seconds,
        "device": str(warp.get_device()),
        "colors_in_the_picture": len(np.unique(context.rgb_data.numpy().reshape(num_envs, -1)[0])),
        "versions": {name: version(name) for name in ("mujoco", "mujoco-warp", "warp-lang")},
    }
    print(json.dumps({"values": values}))


if __name__ == "__main__":
    main()
