"""Packages beside the environment that is running, installed when they are first needed."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

from tests.benchmarks.case import AbsentError


def install_packages(folder: Path, packages: tuple[str, ...], *commands: tuple[str, ...]) -> None:
    """Run commands that install packages into a folder; tried once a process.

    A file in the folder names the packages that it has: with the same ones, nothing is run.
    """
    if why := _failure(folder, packages, commands):
        raise AbsentError(why)


@cache
def _failure(
    folder: Path, packages: tuple[str, ...], commands: tuple[tuple[str, ...], ...]
) -> str | None:
    mark, wanted = folder / ".installed", "\n".join(packages)
    if mark.exists() and mark.read_text("utf-8") == wanted:
        return None
    # A folder that is changed half-way has neither these packages nor those before.
    mark.unlink(missing_ok=True)
    sys.stderr.write(f"Installing {', '.join(packages)} into {folder} ...\n")
    try:
        for command in commands:
            subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        lines = str(getattr(error, "stderr", "") or error).strip().splitlines()
        return f"cannot be installed: {lines[-1] if lines else error}"
    mark.write_text(wanted, "utf-8")
    return None
