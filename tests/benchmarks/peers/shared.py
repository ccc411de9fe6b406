"""What the peers' scripts have in common; it runs in their environments, which lack ours."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import NoReturn

import numpy as np

REPETITIONS = 5

GYMNASIUM_IDS = {
    "halfcheetah": "HalfCheetah-v5",
    "walker2d": "Walker2d-v5",
    "ant": "Ant-v5",
    "humanoid": "Humanoid-v5",
}
"""Our task -> Gymnasium's, whose names EnvPool uses too."""


def speed_of(step: Callable[[], int], seconds: float) -> dict[str, float]:
    """Steps per second over repetitions of so many seconds, after one that warms up."""
    rates = []
    for repetition in range(1 + REPETITIONS):
        steps, started = 0, time.perf_counter()
        while time.perf_counter() - started < seconds:
            steps += step()
        if repetition:
            rates.append(steps / (time.perf_counter() - started))
    return {"median": float(np.median(rates)), "slowest": min(rates), "fastest": max(rates)}


def opengl(probe: str, *arguments: str, variables: tuple[str, ...] = ("MUJOCO_GL",)) -> str:
    """Choose an OpenGL with which a program works, whose last line is the renderer's name.

    It is named in the environment's variables. Where there is none, this process ends with 3.
    """
    why = ""
    for name in [os.environ["MUJOCO_GL"]] if "MUJOCO_GL" in os.environ else ["egl", "osmesa"]:
        chosen = dict.fromkeys(variables, name)
        command = [sys.executable, "-c", probe, *arguments]
        done = subprocess.run(
            command, env=os.environ | chosen, capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            os.environ |= chosen
            return f"{name}: {done.stdout.strip().splitlines()[-1]}"
        why += f"\n{name}: {done.stderr.strip()}"
    return no_opengl(why)


def no_opengl(why: str) -> NoReturn:
    """End this process with the status of what is absent."""
    print(why[-3000:], file=sys.stderr)
    print("no OpenGL works", file=sys.stderr)
    sys.exit(3)
