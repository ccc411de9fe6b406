"""Store outcomes in a file."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench.case import Case


class Results:
    """Outcomes in a JSON file that is written after every case.

    Raises:
        ValueError: the file exists but has no results.
    """

    def __init__(self, file: Path, machine: dict[str, Any]) -> None:
        self.file = file
        self.machine = hashlib.sha256(json.dumps(machine).encode()).hexdigest()[:8]
        self.kept: dict[str, Any] = {"machines": {}, "cases": {}}
        if file.exists():
            try:
                kept = json.loads(file.read_text("utf-8"))
            except ValueError:
                kept = None
            if not isinstance(kept, dict) or not {"machines", "cases"} <= kept.keys():
                raise ValueError(f"{file} is not a result of this benchmark: move or delete it.")
            self.kept = kept
        self.kept["machines"][self.machine] = machine

    def has(self, case: Case) -> bool:
        """Return whether the case has a final result on this machine."""
        known = self.kept["cases"].get(case.key, {})
        learned = known.get("status") in ("ok", "out of memory")
        return learned and known["machine"] == self.machine

    def add(self, case: Case, outcome: dict[str, Any]) -> None:
        """Store an outcome and replace the file atomically."""
        cases = self.kept["cases"]
        cases[case.key] = {
            "group": case.group,
            "measure": case.measure,
            "arguments": dict(case.arguments),
            "machine": self.machine,
            "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
            **outcome,
        }
        used = {known["machine"] for known in cases.values()}
        self.kept["machines"] = {k: v for k, v in self.kept["machines"].items() if k in used}
        part = self.file.with_suffix(".part")
        part.write_text(json.dumps(self.kept, indent=1) + "\n", "utf-8")
        part.replace(self.file)
