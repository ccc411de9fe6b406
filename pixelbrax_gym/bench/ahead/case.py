"""A program to compile, as a case of the benchmark."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from pixelbrax_gym.bench.ahead.environment import install
from pixelbrax_gym.bench.ahead.targets import TPU_ENVIRON
from pixelbrax_gym.bench.case import Case

DUMP = "PIXELBRAX_PROGRAMS_DUMP"
"""Variable that names the folder for what XLA writes of a program, which is removed afterwards."""

PROGRAMS = ("renderer", "plain renderer", "step", "state step", "scan")
"""Programs that are compiled; `programs.py` makes them."""


@dataclass(frozen=True)
class AheadCase(Case):
    """A program that is compiled for another device than there is.

    Attributes:
        package: of the measure.
        platform: ``cuda`` or ``tpu``.
    """

    package: str = "pixelbrax_gym.bench.ahead"
    platform: str = "cuda"

    def environ(self) -> dict[str, str]:
        """Have JAX find the compiler, and XLA write what it makes.

        Raises:
            AbsentError: the compiler cannot be installed.
        """
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
