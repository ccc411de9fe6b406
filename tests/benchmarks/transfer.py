"""Plays the package's policies of the DM Control Suite here and in dm_control, for docs/dmc.md.

    MUJOCO_GL=egl python -m tests.benchmarks.transfer             policies that are new; 5 min each
    MUJOCO_GL=egl python -m tests.benchmarks.transfer walker      those with this in their names

A policy whose file differs from the one that was played is played again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys

from tests.benchmarks.dmc_page import FOLDER
from tests.benchmarks.experiments import EPISODES, PRETRAINED

KEPT = FOLDER / "transfer.json"


def main() -> None:
    """Play them, one after the other; each result is kept at once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", nargs="?", default="", help="part of the names of tasks")
    wanted = parser.parse_args().name
    rows = {row["task"]: row for row in json.loads(KEPT.read_text("utf-8"))}
    for policy in sorted(PRETRAINED.glob("dmc_*.jax")):
        digest = hashlib.sha256(policy.read_bytes()).hexdigest()[:16]
        if wanted not in policy.stem or rows.get(policy.stem, {}).get("policy") == digest:
            continue
        command = [sys.executable, "-m", "pixelbrax_gym.cli", "evaluate"]
        command += ["--pretrained", policy.stem, "--in", "dm_control", "--episodes", str(EPISODES)]
        line = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        rows[policy.stem] = json.loads(line) | {"policy": digest}
        kept = sorted(rows.values(), key=lambda row: row["task"])
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
