"""The cache folder, and programs kept in it."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from pathlib import Path

from pixelbrax_jax.paths import in_home


def cache_folder(given: str | Path | None = None) -> Path:
    """Return the given folder, else ``$PIXELBRAX_CACHE``, else ``~/.cache/pixelbrax``."""
    named = given or os.environ.get("PIXELBRAX_CACHE")
    if named:
        return in_home(named)
    try:
        return Path.home() / ".cache" / "pixelbrax"
    except RuntimeError as error:  # such as a container's user without an entry in passwd
        raise FileNotFoundError(
            "the user has no home folder; set HOME, or PIXELBRAX_CACHE to a folder"
        ) from error


KEEP_PROGRAMS = "PIXELBRAX_KEEP_PROGRAMS"
"""Environment variable: ``1`` keeps compiled programs on import, ``0`` never keeps them."""

_FOLDER, _SHORTEST = "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def keep_programs() -> Path | None:
    """Keep compiled programs in the cache folder, for later processes; imports no JAX.

    Returns the folder for this kind of CPU, because programs may use instructions that other CPUs
    lack; None if JAX has another folder or the environment forbids it. Nothing is ever deleted.
    """
    jax = sys.modules.get("jax")
    told = jax.config.jax_compilation_cache_dir if jax else os.environ.get(_FOLDER)
    if told or os.environ.get(KEEP_PROGRAMS) == "0":
        return None
    folder = cache_folder() / "programs" / _kind_of_cpu()
    # Also for child processes.
    os.environ[_FOLDER] = str(folder)
    os.environ.setdefault(_SHORTEST, "0.3")
    if jax:
        jax.config.update(_FOLDER.lower(), str(folder))
        jax.config.update(_SHORTEST.lower(), float(os.environ[_SHORTEST]))
    return folder


def _kind_of_cpu() -> str:
    features = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text("utf-8", "replace").splitlines()
        features = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:8]
