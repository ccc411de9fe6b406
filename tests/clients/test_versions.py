"""The table in the documentation names the releases that these tests ran with."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TABLE = [
    [cell.strip().strip("`") for cell in line.split("|")[1:-1]]
    for line in (ROOT / "docs" / "clients.md").read_text("utf-8").splitlines()
    if line.startswith("| ")
][2:]
PINS = re.findall(
    r"^([\w-]+)==(\S+)$", (ROOT / "tests/clients/requirements.txt").read_text("utf-8"), re.MULTILINE
)


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row[1])
def test_the_table_names_what_is_installed(row):
    _, package, told, *_ = row
    # A local build's label, as in 2.13.0+cpu, is no other release.
    assert version(package).partition("+")[0] == told


def test_every_file_of_tests_has_a_row():
    files = {path.stem.removeprefix("test_") for path in Path(__file__).parent.glob("test_*.py")}
    # Playground makes tasks, and Warp simulates; they are no clients.
    files -= {"versions", "playground", "warp"}
    names = {"gymnasium_wrappers": "gymnasium", "gymnasium_vector_wrappers": "gymnasium"}
    names |= {"sb3": "stable-baselines3", "cleanrl": "torch"}
    assert {names.get(name, name) for name in files} | {"sb3-contrib"} == {r[1] for r in TABLE}


@pytest.mark.parametrize(("package", "pinned"), PINS)
def test_what_is_pinned_is_installed(package, pinned):
    assert version(package) == pinned
