"""DM Control at 84 x 84: one environment alone, or many under Stable-Baselines3's SubprocVecEnv.

    python dm_control_envs.py '{"domain": "cheetah", "processes": 8, "cores": 8}'

Each environment step is one control step with one image; under SubprocVecEnv the last three are
stacked. `goal`, `camera` and `seconds` of a repetition may be given. Exits with 3 where no OpenGL
works.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from shared import opengl, speed_of

TASKS = {"cheetah": "run", "walker": "walk", "quadruped": "walk", "humanoid": "walk"}
SECONDS, SIZE = 3.0, 84


def load(domain: str, goal: str, seed: int) -> Any:
    from dm_control import suite

    return suite.load(domain, goal, task_kwargs={"random": seed})


PROBE = """
from dm_control import suite
from OpenGL import GL
physics = suite.load('cheetah', 'run').physics
physics.render(8, 8)
with physics.contexts.gl.make_current() as context:
    print(context.call(GL.glGetString, GL.GL_RENDERER).decode())
"""
"""Prints the name of OpenGL's renderer."""


def alone(domain: str, goal: str, camera: int) -> Callable[[], int]:
    """One environment in this process; the function takes one step."""
    env = load(domain, goal, 0)
    env.reset()
    spec, rng = env.action_spec(), np.random.default_rng(0)

    def step() -> int:
        if env.step(rng.uniform(spec.minimum, spec.maximum)).last():
            env.reset()
        env.physics.render(SIZE, SIZE, camera_id=camera)
        return 1

    return step


def vectorised(domain: str, goal: str, camera: int, processes: int) -> Callable[[], int]:
    """Environments in processes of their own; the function takes one step of all."""
    import gymnasium
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack

    class Env(gymnasium.Env):
        def __init__(self, seed: int) -> None:
            self.env = load(domain, goal, seed)
            spec = self.env.action_spec()
            self.action_space = gymnasium.spaces.Box(
                spec.minimum.astype(np.float32), spec.maximum.astype(np.float32)
            )
            self.observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            self.env.reset()
            return self.env.physics.render(SIZE, SIZE, camera_id=camera), {}

        def step(self, action: np.ndarray) -> Any:
            step = self.env.step(action)
            image = self.env.physics.render(SIZE, SIZE, camera_id=camera)
            return image, float(step.reward or 0.0), False, bool(step.last()), {}

    makers = [lambda seed=seed: Env(seed) for seed in range(processes)]
    envs = VecFrameStack(SubprocVecEnv(makers), 3, channels_order="last")
    envs.reset()
    rng = np.random.default_rng(0)
    low, high = envs.action_space.low, envs.action_space.high

    def step() -> int:
        envs.step(rng.uniform(low, high, (processes, *low.shape)).astype(np.float32))
        return processes

    return step


def main() -> None:
    arguments = json.loads(sys.argv[1])
    import dm_control  # noqa: F401  # a missing one is no matter of OpenGL

    renderer = opengl(PROBE)
    domain, processes = arguments["domain"], arguments["processes"]
    processes = arguments["cores"] if processes == "cores" else processes
    goal, camera = arguments.get("goal", TASKS.get(domain)), arguments.get("camera", 0)
    which = (domain, goal, camera)
    step = vectorised(*which, processes) if processes else alone(*which)
    speed = speed_of(step, arguments.get("seconds", SECONDS))
    env = load(domain, goal, 0)
    env.reset()
    if np.ptp(env.physics.render(SIZE, SIZE, camera_id=camera)) == 0:
        raise RuntimeError("it draws nothing")
    from importlib.metadata import version

    values = {
        "steps_per_second": speed["median"],
        "speed": speed,
        "processes": processes,
        "control_dt": env.control_timestep(),
        "opengl": renderer,
        "versions": {name: version(name) for name in ("dm_control", "mujoco")},
    }
    print(json.dumps({"values": values}))


if __name__ == "__main__":
    main()
