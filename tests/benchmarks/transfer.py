"""Plays trained policies of the DM Control Suite in dm_control, for docs/howto/dm-control.md.

    MUJOCO_GL=egl python -m tests.benchmarks.transfer             the package's policies, 5 min each
    MUJOCO_GL=egl python -m tests.benchmarks.transfer RUN...      those of runs

A policy that was played already is not played again. A task and seed keep their latest policy.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from pathlib import Path

from tests.benchmarks.dmc_page import FOLDER
from tests.benchmarks.experiments import EPISODES, PRETRAINED

KEPT = FOLDER / "transfer.json"


def main() -> None:
    """Play them, one after the other; each result is kept at once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path, help="folders of runs")
    runs = parser.parse_args().runs
    files = [run / "policy.jax" for run in runs] or sorted(PRETRAINED.glob("dmc_*.jax"))
    rows = json.loads(KEPT.read_text("utf-8"))
    for file in files:
        digest = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        if any(row["policy"] == digest for row in rows):
            continue
        source = [str(file.parent)] if runs else ["--pretrained", file.stem]
        command = [sys.executable, "-m", "pixelbrax_gym.cli", "evaluate", *source]
        command += ["--in", "dm_control", "--episodes", str(EPISODES)]
        line = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        new = json.loads(line) | {"policy": digest}
        rows = [row for row in rows if key(row) != key(new)] + [new]
        KEPT.write_text(json.dumps(sorted(rows, key=key), indent=1) + "\n")


def key(row: dict) -> tuple[str, int]:
    """What has one policy."""
    return row["task"], row["seed"]


if __name__ == "__main__":
    main()
