"""A program to compile, as a case of the benchmark, and the compiler that it takes."""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from pixelbrax_jax.cache import cache_folder
from tests.benchmarks.ahead.targets import TPU_ENVIRON
from tests.benchmarks.case import AbsentError, Case
from tests.benchmarks.packages import install_packages

DUMP = "PIXELBRAX_PROGRAMS_DUMP"
"""Variable that names the folder for what XLA writes of a program, which is removed afterwards."""


PROGRAMS = ("renderer", "plain renderer", "step", "state step", "scan")
"""Frames, drawn as the device has it and by the plain ray-caster; a step with pixels, and without;
a loop over steps with pixels."""


MUJOCO_STEPS = [
    {
        **{"task": f"dmc_{task}", "program": "state step", "num_envs": 1024},
        **{"card": "H100", "num_starts": 4096},
    }
    for task in (
        *("cartpole_swingup", "walker_walk", "cheetah_run", "finger_spin"),
        *("reacher_easy", "hopper_hop", "humanoid_walk"),
    )
]
"""Steps of DM Control's tasks, by MuJoCo XLA."""
# With starts that settle, and that are sampled until they are valid.
MUJOCO_STEPS += [
    {"task": task, "program": "state step", "num_envs": 1024, "card": "H100"}
    for task in ("dmc_cheetah_run", "dmc_finger_spin")
]

TRAINING = [
    {
        "task": "dmc_reacher_easy",
        "program": "iteration",
        "num_envs": 256,
        "card": "H100",
        "num_starts": 4096,
        "algorithm": algorithm,
        "preset": preset,
    }
    for algorithm, preset in (("drqv2", "fast"), ("ppo", "cpu"))
]
"""All that an algorithm does between two logs."""


@dataclass(frozen=True)
class AheadCase(Case):
    """A program that is compiled for another device than there is: ``cuda`` or ``tpu``."""

    package: str = "tests.benchmarks.ahead"
    platform: str = "cuda"

    def environ(self) -> dict[str, str]:
        """Have JAX find the compiler, and XLA write what it makes."""
        path = [str(install(self.platform)), os.environ.get("PYTHONPATH", "")]
        environ = {
            "PYTHONPATH": os.pathsep.join(filter(None, path)),
            # Programs are compiled, never run; the plugins then ask for no device.
            "JAX_PLATFORMS": "cpu",
            "TF_CPP_MIN_LOG_LEVEL": "3",
        }
        if self.platform == "tpu":
            return environ | TPU_ENVIRON
        dump = Path(tempfile.mkdtemp(prefix="pixelbrax-programs-"))
        flags = (
            os.environ.get("XLA_FLAGS", ""),
            # Kernels are tried out on a device otherwise.
            "--xla_gpu_autotune_level=0",
            f"--xla_dump_to={dump} --xla_dump_hlo_as_text --xla_dump_hlo_module_re=.*ahead.*",
        )
        return environ | {DUMP: str(dump), "XLA_FLAGS": " ".join(filter(None, flags))}


def packages(platform: str) -> tuple[str, ...]:
    """What is installed, at the release of the JAX that is running."""
    if platform == "tpu":
        return ("libtpu",)
    release = version("jax")
    return (f"jax-cuda12-plugin=={release}", f"jax-cuda12-pjrt=={release}", "nvidia-cuda-nvcc-cu12")


def install(platform: str) -> Path:
    """Install what is lacking, 600 MB for ``cuda`` and 500 MB for ``tpu``; return its folder.

    Nothing enters the environment that is running, whose JAX finds the plugins by ``PYTHONPATH``.
    """
    try:
        home = cache_folder() / "compilers"
    except FileNotFoundError as error:
        raise AbsentError(str(error)) from error
    python = f"py{sys.version_info[0]}{sys.version_info[1]}"
    target, wanted = home / f"{platform}-jax{version('jax')}-{python}", packages(platform)
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    into = ("--no-deps", "--upgrade", "--target", str(target))
    install_packages(target, wanted, (*pip, *into, *wanted))
    return target
