"""Gymnasium's MuJoCo tasks seen through their own renderer, one process a core.

python gymnasium_envs.py '{"task": "ant", "cores": 2}'
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from shared import GYMNASIUM_IDS, opengl, speed_of

SECONDS, SIZE = 3.0, 84


def make(name: str) -> Any:
    """An environment whose observations are its images."""
    import gymnasium

    env = gymnasium.make(name, render_mode="rgb_array", width=SIZE, height=SIZE)
    return gymnasium.wrappers.AddRenderObservation(env)


PROBE = """
import sys; sys.path.insert(0, sys.argv[1])
from gymnasium_envs import make
env = make(sys.argv[2])
env.reset()
from OpenGL import GL
print(GL.glGetString(GL.GL_RENDERER).decode())
"""
"""Prints the name of OpenGL's renderer."""


def main() -> None:
    from importlib.metadata import version

    import gymnasium

    arguments = json.loads(sys.argv[1])
    name, processes = GYMNASIUM_IDS[arguments["task"]], arguments["cores"]
    variables = ("MUJOCO_GL", "PYOPENGL_PLATFORM")
    renderer = opengl(PROBE, str(Path(__file__).parent), name, variables=variables)
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
