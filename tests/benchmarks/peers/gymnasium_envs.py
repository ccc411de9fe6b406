"""Gymnasium's MuJoCo tasks seen through their own renderer, one process a core.

python gymnasium_envs.py '{"task": "ant", "cores": 2}'
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from shared import GYMNASIUM_IDS, speed_of

SECONDS, SIZE = 3.0, 84


def make(name: str) -> Any:
    """An environment whose observations are its images."""
    import gymnasium

    env = gymnasium.make(name, render_mode="rgb_array", width=SIZE, height=SIZE)
    return gymnasium.wrappers.AddRenderObservation(env)


def opengl(name: str) -> str:
    """Chooses an OpenGL that works; the name of its renderer."""
    probe = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from gymnasium_envs import make\n"
        "env = make(sys.argv[2])\n"
        "env.reset()\n"
        "from OpenGL import GL\n"
        "print(GL.glGetString(GL.GL_RENDERER).decode())\n"
    )
    why = ""
    for library in [os.environ["MUJOCO_GL"]] if "MUJOCO_GL" in os.environ else ["egl", "osmesa"]:
        environ = os.environ | {"MUJOCO_GL": library, "PYOPENGL_PLATFORM": library}
        command = [sys.executable, "-c", probe, str(Path(__file__).parent), name]
        done = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            os.environ |= {"MUJOCO_GL": library, "PYOPENGL_PLATFORM": library}
            return f"{library}: {done.stdout.strip().splitlines()[-1]}"
        why += f"\n{library}: {done.stderr.strip()}"
    print(why[-3000:], file=sys.stderr)
    print("no OpenGL works", file=sys.stderr)
    sys.exit(3)


def main() -> None:
    from importlib.metadata import version

    import gymnasium

    arguments = json.loads(sys.argv[1])
    name, processes = GYMNASIUM_IDS[arguments["task"]], arguments["cores"]
    renderer = opengl(name)
    envs = gymnasium.vector.AsyncVectorEnv([lambda: make(name)] * processes, context="spawn")
    if np.ptp(envs.reset(seed=0)[0]) == 0:
        raise RuntimeError("it draws nothing")

    def step() -> int:
        envs.step(envs.action_space.sample())
        return processes

    speed = speed_of(step, SECONDS)
    envs.close()
    values = {
        "steps_per_second": speed["median"],
        "speed": speed,
        "processes": processes,
        "opengl": renderer,
        "versions": {name: version(name) for name in ("gymnasium", "mujoco")},
    }
    print(json.dumps({"values": values}))


if __name__ == "__main__":
    main()
