"""Outcomes in a file of JSON lines, which grows by a line at each."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.benchmarks.case import Case

MACHINE = "machine"
FINAL = ("ok", "out of memory")
"""Statuses of cases that are not measured again."""


class Results:
    """What is known in a folder.

    The first line describes the machine; each of the others is an outcome. Of several outcomes of a
    case the last one counts, and a line that was cut short while it was written counts for nothing.
    """

    def __init__(self, folder: Path) -> None:
        self.file = folder / "results.jsonl"
        self.machine: dict[str, Any] = {}
        self.rows: dict[str, dict[str, Any]] = {}
        if self.file.exists():
            for line in self.file.read_text("utf-8", "replace").splitlines():
                try:
                    row = json.loads(line)
                except ValueError:
                    continue
                if MACHINE in row:
                    self.machine = row[MACHINE]
                elif "key" in row:
                    self.rows[row["key"]] = row

    def start(self, machine: dict[str, Any]) -> None:
        """Take note of the machine.

        Raises:
            ValueError: the folder has outcomes of another one, or of another release of JAX.
        """
        if not self.machine:
            self.machine = machine
            self._append({MACHINE: machine})
        for what, old, new in (
            ("device", self.machine["device"], machine["device"]),
            ("jax", self.machine["versions"]["jax"], machine["versions"]["jax"]),
            ("--rehearse", self.machine["rehearsal"], machine["rehearsal"]),
        ):
            if old != new:
                raise ValueError(
                    f"--output-dir {self.file.parent} has results of another machine ({what} "
                    f"{old}, here {new}): give another folder, or delete it."
                )

    def has(self, case: Case) -> bool:
        """Return whether the case need not be measured again."""
        return self.rows.get(case.key, {}).get("status") in FINAL

    def add(self, case: Case, outcome: dict[str, Any]) -> None:
        """Keep an outcome."""
        row = {
            "key": case.key,
            "group": case.group,
            "measure": case.measure,
            "arguments": dict(case.arguments),
            "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
            **outcome,
        }
        self.rows[case.key] = row
        self._append(row)

    def _append(self, row: dict[str, Any]) -> None:
        self.file.parent.mkdir(parents=True, exist_ok=True)
        cut_short = False
        if self.file.exists() and (size := self.file.stat().st_size):
            with self.file.open("rb") as kept:
                kept.seek(size - 1)
                cut_short = kept.read(1) != b"\n"
        with self.file.open("a", encoding="utf-8") as file:
            file.write("\n" * cut_short + json.dumps(row) + "\n")
            file.flush()
            os.fsync(file.fileno())
