"""MuJoCo Warp's ray tracer on a task's own model, in the same pose and seen from our camera.

    python mujoco_warp_renderer.py '{"num_envs": 256, "size": 84, "cores": 2, "scene": {...}}'

``scene`` comes from ``tests.benchmarks.scene``. A frame costs the refit of the bounding volumes
and the image; there are no textures and no shadows. Warp runs its kernels in one thread on a
CPU, so there is a process for each core, with ``num_envs`` worlds each, and their rates are summed.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from typing import Any

import numpy as np

REPETITIONS, SECONDS = 5, 2.0

PATIENCE = 300.0
"""Seconds that a process waits for the others."""


def prepare(scene: dict[str, Any], num_envs: int, size: int) -> Any:
    """A function that draws all worlds once, and the context that holds their images."""
    try:
        import mujoco
        import mujoco_warp as mjw
        import warp as wp
    except ImportError as error:
        print(f"its wheel does not run here: {error}", file=sys.stderr)
        sys.exit(3)

    model = mujoco.MjModel.from_xml_string(scene["xml"])
    data = mujoco.MjData(model)
    data.qpos[:] = scene["qpos"]
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=num_envs)
    context = mjw.create_render_context(
        model,
        nworld=num_envs,
        cam_res=(size, size),
        render_rgb=True,
        render_depth=False,
        use_textures=False,
        use_shadows=False,
    )

    def launch() -> None:
        mjw.refit_bvh(m, d, context)
        mjw.render(m, d, context)

    launch()
    wp.synchronize()
    if wp.get_device().is_cpu:
        return launch, context
    with wp.ScopedCapture() as captured:
        launch()
    return lambda: wp.capture_launch(captured.graph), context


def rates_of(scene: dict[str, Any], num_envs: int, size: int, ready: Any) -> list[float]:
    """Frames per second of each repetition, begun when all processes are ready."""
    import warp

    draw, _ = prepare(scene, num_envs, size)
    ready.wait(PATIENCE)
    rates = []
    for _ in range(REPETITIONS):
        frames, started = 0, time.perf_counter()
        while time.perf_counter() - started < SECONDS:
            for _ in range(4):
                draw()
            warp.synchronize()
            frames += 4 * num_envs
        rates.append(frames / (time.perf_counter() - started))
    return rates


def main() -> None:
    from importlib.metadata import version

    arguments = json.loads(sys.argv[1])
    scene, num_envs = arguments["scene"], arguments["num_envs"]
    started = time.perf_counter()
    _, context = prepare(scene, num_envs, arguments["size"])
    compile_seconds = time.perf_counter() - started
    import warp

    on_cpu = warp.get_device().is_cpu
    processes = arguments["cores"] if on_cpu else 1
    if np.ptp(context.rgb_data.numpy()) == 0:
        raise RuntimeError("it draws nothing")
    spawn = multiprocessing.get_context("spawn")
    with spawn.Manager() as manager, spawn.Pool(processes) as pool:
        ready = manager.Barrier(processes)
        work = [(scene, num_envs, arguments["size"], ready)] * processes
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
        "versions": {name: version(name) for name in ("mujoco", "mujoco-warp", "warp-lang")},
    }
    print(json.dumps({"values": values}))


if __name__ == "__main__":
    main()
