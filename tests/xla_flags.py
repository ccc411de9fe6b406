"""Flags of XLA under which the tests compile; imports no JAX, which reads them once."""

from __future__ import annotations

import mmap
from importlib.util import find_spec
from pathlib import Path


def xla_flags(optimize: bool) -> str:
    """Return XLA's flags for the tests.

    Every program is compiled with the width of vectors that the package asks for by itself, or
    results of different ones could not be compared to the bit (``compiler_options``). Compiling
    takes most of the time of the tests, and a third of it without optimisation; what is compared
    is compiled alike.

    Args:
        optimize: whether programs are optimised as those of users are.
    """
    flags = ["--xla_cpu_prefer_vector_width=512"]
    if not optimize:
        flags.append("--xla_backend_optimization_level=0")
        if is_known("xla_cpu_use_fusion_emitters"):
            flags.append("--xla_cpu_use_fusion_emitters=false")
    return " ".join(flags)


def is_known(flag: str) -> bool:
    """Return whether the installed XLA has a flag; one that it does not have ends the process."""
    spec = find_spec("jaxlib")
    if spec is None or spec.origin is None:
        return False
    for path in Path(spec.origin).parent.glob("libjax_common*"):
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            if text.find(flag.encode()) >= 0:
                return True
    return False
