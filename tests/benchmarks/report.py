"""Store outcomes in a file, and write them as a page of tables."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench.tables import table
from pixelbrax_jax.paths import replacing
from tests.benchmarks.case import Case, Group, Row

_HEADING = (
    "# Measurements",
    "Medians of at least five repetitions of half a second or more, unless a part says "
    "otherwise. Times exclude compilation and include waiting for every result. Actions are "
    "random, and episodes reset automatically. Each case runs in a separate process.",
)


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
        write_whole(self.file, json.dumps(self.kept, indent=1) + "\n")

    def write_page(self, groups: Mapping[str, Group]) -> None:
        """Write the page beside the file."""
        write_whole(self.file.with_suffix(".md"), page(self.kept, groups))


def write_whole(file: Path, text: str) -> None:
    """Write a file that is complete at any time."""
    with replacing(file) as part:
        part.write_text(text, "utf-8")


def page(kept: Mapping[str, Row], groups: Mapping[str, Group]) -> str:
    """Return the results as a page in Markdown."""
    known = {case.key for group in groups.values() for case in group.cases}
    rows = [row for key, row in kept["cases"].items() if key in known]
    used = {row["machine"] for row in rows}
    parts = [
        *_HEADING,
        *(_machine(machine) for name, machine in kept["machines"].items() if name in used),
    ]
    for name, group in groups.items():
        of_group = [row for row in rows if row["group"] == name]
        if of_group:
            dates = " and ".join(sorted({row["date"][:10] for row in of_group}))
            parts += [f"## {name.capitalize()}", f"{dates}. {group.note}", group.table(of_group)]
    missing = [row for row in rows if row["status"] != "ok"]
    if missing:
        lines = [
            (
                " ".join([row["measure"], *(f"{k}={v}" for k, v in row["arguments"].items())]),
                row["status"],
                " ".join(row["why"].split()).replace("|", "/")[-200:],
            )
            for row in missing
        ]
        parts += ["## Not measured", table(("case", "", "why"), lines)]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _machine(machine: Row) -> str:
    versions = ", ".join(f"{name} {v}" for name, v in machine["versions"].items() if v)
    vectors = f" with {machine['vectors']}" if machine["vectors"] else ""
    return (
        f"{machine['device']} ({machine['processor']}{vectors}, {machine['cores']} cores), "
        f"{machine['system']}, Python {machine['python']}; {versions}. "
        f"XLA_FLAGS: `{machine['xla_flags'] or 'none'}`."
    )
