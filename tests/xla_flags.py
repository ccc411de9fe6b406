"""Flags of XLA under which the tests compile; imports no JAX, which reads them once."""

from __future__ import annotations

import mmap
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def xla_flags(optimize: bool) -> str:
    """Return XLA's flags for the tests.

    Every program is compiled with the width of vectors that the package asks for by itself, or
    results of different ones could not be compared to the bit (``compiler_options``). Compiling
    takes most of the time of the tests, and a third of it without optimisation; what is compared
    is compiled alike.

    Args:
        optimize: whether programs are optimised as those of users are.
    """
    flags = {"xla_cpu_prefer_vector_width": 512}
    # The parts of a program would be compiled side by side, on cores that another worker has.
    if is_known("xla_cpu_parallel_codegen_split_count"):
        flags["xla_cpu_parallel_codegen_split_count"] = 1
    if not optimize:
        flags |= {name: off for name, (off, _) in _optimizations().items()}
    return " ".join(f"--{name}={str(value).lower()}" for name, value in flags.items())


def optimized() -> dict[str, Any]:
    """Return options of ``jax.jit`` that optimise a program: one that runs for long."""
    return {name: on for name, (_, on) in _optimizations().items()}


def _optimizations() -> dict[str, tuple[Any, Any]]:
    """Return flags by name, with the value that turns optimisation off, and the one of users."""
    known = {"xla_backend_optimization_level": (0, 3)}
    if is_known("xla_cpu_use_fusion_emitters"):
        known["xla_cpu_use_fusion_emitters"] = (False, True)
    return known


def is_known(flag: str) -> bool:
    """Return whether the installed XLA has a flag; one that it does not have ends the process."""
    spec = find_spec("jaxlib")
    if spec is None or spec.origin is None:
        return False
    for path in Path(spec.origin).parent.glob("libjax_common*"):
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            # Without the zeros it is a field of a message, too.
            if text.find(b"\0" + flag.encode() + b"\0") >= 0:
                return True
    return False
