"""Registers and spills of kernels, as NVIDIA's assembler finds them."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

_USED = re.compile(
    r"(\d+) bytes spill stores, (\d+) bytes spill loads.*?Used (\d+) registers", re.S
)


def find_assembler() -> str | None:
    """Return the path of ``ptxas`` of the wheel ``nvidia-cuda-nvcc-cu12`` or of the system."""
    try:
        spec = find_spec("nvidia.cuda_nvcc")
    except ModuleNotFoundError:
        spec = None
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        found = Path(folder) / "bin" / "ptxas"
        if found.exists():
            # pip unpacks programs of wheels without the right to run them into a target folder.
            found.chmod(0o755)
            return str(found)
    return shutil.which("ptxas")


def assemble(sources: list[Path], architecture: str) -> dict[str, int] | None:
    """Return what kernels take that need most.

    Args:
        sources: kernels in PTX, one or more in a file.
        architecture: such as ``sm_90a``.

    Returns:
        ``registers``, the most of a thread, and ``spilled``, the bytes of the one that spills most;
        None without an assembler that takes these kernels.
    """
    assembler = find_assembler()
    most: dict[str, int] | None = None
    for source in sources if assembler else ():
        command = [str(assembler), "-v", f"-arch={architecture}", "-o", "/dev/null", str(source)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return None
        for stores, loads, registers in _USED.findall(done.stderr):
            most = most or {"registers": 0, "spilled": 0}
            most["registers"] = max(most["registers"], int(registers))
            most["spilled"] = max(most["spilled"], int(stores) + int(loads))
    return most
