"""Gymnasium's MuJoCo tasks seen through their own renderer, one process a core.

python gymnasium_envs.py '{"task": "ant"}'
"""

from __future__ import annotations

import json
import os
import sys
import time

import numpy as np

IDS = {
    "halfcheetah": "HalfCheetah-v5",
    "walker2d": "Walker2d-v5",
    "ant": "Ant-v5",
    "humanoid": "Humanoid-v5",
}
REPETITIONS, SECONDS, SIZE = 5, 3.0, 84


def make(name: str):
    import gymnasium

    env = gymnasium.make(name, render_mode="rgb_array", width=SIZE, height=SIZE)
    return gymnasium.wrappers.AddRenderObservation(env)


def main() -> None:
    from importlib.metadata import version

    import gymnasium

    name = IDS[json.loads(sys.argv[1])["task"]]
    processes = len(os.sched_getaffinity(0))
    for library in [os.environ["MUJOCO_GL"]] if "MUJOCO_GL" in os.environ else ["egl", "osmesa"]:
        os.environ["MUJOCO_GL"] = library
        envs = gymnasium.vector.AsyncVectorEnv([lambda: make(name)] * processes, context="spawn")
        try:
            envs.reset(seed=0)
            break
        except Exception as error:
            why = str(error)
            envs.close(terminate=True)
    else:
        print(f"no OpenGL works: {why}", file=sys.stderr)
        sys.exit(3)
    rates = []
    for repetition in range(1 + REPETITIONS):
        steps, started = 0, time.perf_counter()
        while time.perf_counter() - started < SECONDS:
            envs.step(envs.action_space.sample())
            steps += processes
        if repetition:  # the first one warms up
            rates.append(steps / (time.perf_counter() - started))
    envs.close()
    values = {
        "steps_per_second": float(np.median(rates)),
        "speed": {"median": float(np.median(rates)), "slowest": min(rates), "fastest": max(rates)},
        "processes": processes,
        "opengl": os.environ["MUJOCO_GL"],
        "versions": {name: version(name) for name in ("gymnasium", "mujoco")},
    }
    print(json.dumps({"values": values}))


if __name__ == "__main__":
    main()
