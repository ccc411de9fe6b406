"""MuJoCo Warp's ray tracer on a task's own model, seen from our camera.

    python mujoco_warp_renderer.py '{"task": "ant", "num_envs": 256, "scene": {...}}'

``scene`` comes from ``tests.benchmarks.scene``. A frame costs the refit of the bounding volumes
and the picture; there are no textures and no shadows. The bodies are in their first pose.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

REPETITIONS, SECONDS, SIZE = 5, 2.0, 84


def main() -> None:
    from importlib.metadata import version

    arguments = json.loads(sys.argv[1])
    scene, num_envs = arguments["scene"], arguments["num_envs"]
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
    mujoco.mj_forward(model, data)
    wp.init()
    device = wp.get_device()
    started = time.perf_counter()
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

    def frame() -> None:
        mjw.refit_bvh(m, d, context)
        mjw.render(m, d, context)
        wp.synchronize()

    frame()
    compile_seconds = time.perf_counter() - started
    rates = []
    for _ in range(REPETITIONS):
        frames, started = 0, time.perf_counter()
        while time.perf_counter() - started < SECONDS:
            frame()
            frames += num_envs
        rates.append(frames / (time.perf_counter() - started))
    pixels = context.rgb_data.numpy()
    values = {
        "frames_per_second": float(np.median(rates)),
        "speed": {"median": float(np.median(rates)), "slowest": min(rates), "fastest": max(rates)},
        "compile_seconds": compile_seconds,
        "device": str(device),
        "geoms": int(model.ngeom),
        "colors_in_the_picture": len(np.unique(pixels.reshape(num_envs, -1)[0])),
        "versions": {name: version(name) for name in ("mujoco", "mujoco-warp", "warp-lang")},
    }
    print(json.dumps({"values": values}))


if __name__ == "__main__":
    main()
