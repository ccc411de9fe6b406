"""What compiling ahead of time takes, installed beside the environment that is running."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

from pixelbrax_gym.bench.case import AbsentError


def packages(platform: str) -> tuple[str, ...]:
    """Return what is installed, at the release of the JAX that is running.

    Args:
        platform: ``cuda`` or ``tpu``.
    """
    if platform == "tpu":
        return ("libtpu",)
    release = version("jax")
    return (f"jax-cuda12-plugin=={release}", f"jax-cuda12-pjrt=={release}", "nvidia-cuda-nvcc-cu12")


def folder(platform: str) -> Path:
    """Return the folder that they are in once they are installed, in the cache of PixelBrax."""
    home = Path(os.environ.get("PIXELBRAX_CACHE") or Path.home() / ".cache" / "pixelbrax")
    python = f"py{sys.version_info[0]}{sys.version_info[1]}"
    return home / "compilers" / f"{platform}-jax{version('jax')}-{python}"


def install(platform: str) -> Path:
    """Install what is lacking: 300 MB for ``cuda``, 350 MB for ``tpu``; tried once a process.

    Nothing enters the environment that is running, whose JAX finds the plugins by ``PYTHONPATH``.

    Returns:
        The folder.

    Raises:
        AbsentError: pip cannot install it.
    """
    found = _install(platform)
    if isinstance(found, AbsentError):
        raise found
    return found


@cache
def _install(platform: str) -> Path | AbsentError:
    target, wanted = folder(platform), packages(platform)
    mark = target / ".installed"
    if mark.exists() and mark.read_text("utf-8") == "\n".join(wanted):
        return target
    sys.stderr.write(f"Installing {', '.join(wanted)} into {target} ...\n")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--upgrade"]
    command += ["--disable-pip-version-check", "--target", str(target), *wanted]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        lines = str(getattr(error, "stderr", "") or error).strip().splitlines()
        return AbsentError(f"cannot be installed: {lines[-1] if lines else error}")
    mark.write_text("\n".join(wanted), "utf-8")
    return target
