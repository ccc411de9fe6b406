"""EnvPool's MuJoCo tasks with pixels, the fastest of four settings.

There are as many environments as cores, or two or four times as many; a step waits for all of
them or for as many as there are cores.

    python envpool_envs.py '{"task": "ant", "cores": 2}'

Its wheel brings an EGL that finds no device where there is only a software OpenGL; the system's EGL
or OSMesa, loaded before it, does.
"""

from __future__ import annotations

import ctypes.util
import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
from shared import GYMNASIUM_IDS, no_opengl, speed_of

SECONDS, SIZE = 2.0, 84


def with_opengl() -> None:
    """Runs this script again for each OpenGL until one works, and ends as that run did."""
    why = "there is no libEGL and no libOSMesa"
    for library in filter(None, map(ctypes.util.find_library, ("EGL", "OSMesa"))):
        environ = os.environ | {"LD_PRELOAD": library, "PIXELBRAX_OPENGL": library}
        done = subprocess.run(
            [sys.executable, *sys.argv], env=environ, capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            print(done.stdout.strip().splitlines()[-1])
            sys.exit(0)
        why = (done.stderr or done.stdout).strip()
        if "OpenGL" not in why:
            print(why[-3000:], file=sys.stderr)
            sys.exit(done.returncode)
    no_opengl(why)


def measure(name: str, num_envs: int, batch_size: int, cores: int) -> dict[str, Any]:
    """Steps per second with ``batch_size`` of ``num_envs`` environments a step."""
    import envpool

    envs = envpool.make(
        name,
        env_type="gymnasium",
        num_envs=num_envs,
        batch_size=batch_size,
        num_threads=cores,
        from_pixels=True,
        render_width=SIZE,
        render_height=SIZE,
    )
    space = envs.action_space
    rng, last = np.random.default_rng(0), {}
    envs.async_reset()

    def step() -> int:
        last["obs"], *_, info = envs.recv()
        action = rng.uniform(space.low, space.high, (batch_size, *space.shape))
        envs.send(action.astype(space.dtype), info["env_id"])
        return batch_size

    speed = speed_of(step, SECONDS)
    if np.ptp(last["obs"]) == 0:
        raise RuntimeError("it draws nothing")
    envs.close()
    return {
        "steps_per_second": speed["median"],
        "speed": speed,
        "num_envs": num_envs,
        "batch_size": batch_size,
        "observation": list(np.shape(last["obs"])),
    }


def main() -> None:
    from importlib.metadata import version

    if "PIXELBRAX_OPENGL" not in os.environ:
        with_opengl()
    arguments = json.loads(sys.argv[1])
    name, cores = GYMNASIUM_IDS[arguments["task"]], arguments["cores"]
    sizes = ((cores, cores), (4 * cores, 4 * cores), (2 * cores, cores), (4 * cores, cores))
    runs = [measure(name, num_envs, batch_size, cores) for num_envs, batch_size in sizes]
    best = max(runs, key=lambda run: run["steps_per_second"])
    best["opengl"] = os.environ["PIXELBRAX_OPENGL"]
    best["versions"] = {"envpool": version("envpool")}
    print(json.dumps({"values": best}))


if __name__ == "__main__":
    main()
