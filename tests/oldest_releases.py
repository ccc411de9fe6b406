"""Print the oldest releases that ``pyproject.toml`` allows, as constraints for pip."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

WITHOUT_TORCH = ("train", "dmc", "clips", "dataset", "human", "video", "test")
"""Extras of which the tests that need no torch make use."""


def oldest_releases(pyproject: Path) -> list[str]:
    """Return a pin for each requirement of the package and of those extras."""
    project = tomllib.loads(pyproject.read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"], *(line for name in WITHOUT_TORCH for line in extras[name])]
    pins = set()
    for requirement in map(Requirement, lines):
        bounds = [part.version for part in requirement.specifier if part.operator == ">="]
        if requirement.name != "pixelbrax":
            if len(bounds) != 1:
                raise ValueError(f"{requirement} has no lower bound.")
            pins.add(f"{requirement.name}=={bounds[0]}")
    return sorted(pins)


if __name__ == "__main__":
    for pin in oldest_releases(Path(__file__).parents[1] / "pyproject.toml"):
        sys.stdout.write(f"{pin}\n")
