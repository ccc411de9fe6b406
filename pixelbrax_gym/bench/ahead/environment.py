"""What compiling ahead of time takes, installed beside the environment that is running."""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

from pixelbrax_gym.bench.case import AbsentError
from pixelbrax_gym.bench.packages import install_packages
from pixelbrax_jax.cache import cache_folder


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
    """Return the folder that they are in once they are installed, in the cache of PixelBrax.

    Raises:
        AbsentError: no cache is named, and the user has no home folder.
    """
    try:
        home = cache_folder()
    except FileNotFoundError as error:
        raise AbsentError(str(error)) from error
    python = f"py{sys.version_info[0]}{sys.version_info[1]}"
    return home / "compilers" / f"{platform}-jax{version('jax')}-{python}"


def install(platform: str) -> Path:
    """Install what is lacking: 600 MB on disk for ``cuda``, 500 MB for ``tpu``.

    Nothing enters the environment that is running, whose JAX finds the plugins by ``PYTHONPATH``.

    Returns:
        The folder.

    Raises:
        AbsentError: pip cannot install it.
    """
    target, wanted = folder(platform), packages(platform)
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    into = ("--no-deps", "--upgrade", "--target", str(target))
    install_packages(target, wanted, (*pip, *into, *wanted))
    return target
