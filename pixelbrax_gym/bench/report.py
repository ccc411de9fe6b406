"""Results -> a page of tables, and a plot."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from pixelbrax_gym.bench.case import Group, Row
from pixelbrax_gym.bench.plot import plot
from pixelbrax_gym.bench.tables import table

_MEASURED = (
    "# Measurements",
    "Medians of at least five repetitions of half a second or more, unless a part says "
    "otherwise; compilation is apart, every call is waited for, actions are drawn, and "
    "episodes begin anew. Each case has a process of its own.",
)
_COMPILED = (
    "# Compiled, not run",
    "Programs compiled ahead of time for accelerators that need not be here, and what the compiler "
    "made of them. Compiled on:",
)


def write(file: Path, groups: Mapping[str, Group]) -> None:
    """Write the page, and with matplotlib the plot, that belong to the results in ``file``."""
    kept = json.loads(file.read_text("utf-8"))
    known = {case.key for group in groups.values() for case in group.cases()}
    rows = [row for key, row in kept["cases"].items() if key in known]
    picture = file.with_suffix(".png")
    plotted = find_spec("matplotlib") is not None and plot(rows, picture)
    if not plotted:
        picture.unlink(missing_ok=True)
    part = file.with_suffix(".md.part")
    text = page(kept["machines"], rows, groups, picture.name if plotted else None)
    part.write_text(text, "utf-8")
    part.replace(file.with_suffix(".md"))


def page(
    machines: Mapping[str, Row], rows: list[Row], groups: Mapping[str, Group], plot: str | None
) -> str:
    """The page, in Markdown."""
    used = {row["machine"] for row in rows}
    measured = any(group.measured for group in groups.values())
    parts = [
        *(_MEASURED if measured else _COMPILED),
        *(_machine(machine) for name, machine in machines.items() if name in used),
    ]
    if plot:
        parts.append(f"![Steps per second over the number of environments]({plot})")
    for name, group in groups.items():
        of_group = [row for row in rows if row["group"] == name]
        if of_group:
            dates = " and ".join(sorted({row["date"][:10] for row in of_group}))
            parts += [f"## {name.capitalize()}", f"{dates}. {group.note}", group.table(of_group)]
    missing = [row for row in rows if row["status"] != "ok"]
    if missing:
        lines = [(_name(row), row["status"], _line(row["why"])) for row in missing]
        parts += ["## Not measured", table(("case", "", "why"), lines)]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _machine(machine: Row) -> str:
    versions = ", ".join(f"{name} {v}" for name, v in machine["versions"].items() if v)
    # Results from before vectors were noted have none.
    vectors = f" with {machine['vectors']}" if machine.get("vectors") else ""
    return (
        f"{machine['device']} ({machine['processor']}{vectors}, {machine['cores']} cores), "
        f"{machine['system']}, Python {machine['python']}; {versions}. "
        f"XLA_FLAGS: `{machine['xla_flags'] or 'none'}`."
    )


def _name(row: Row) -> str:
    return " ".join([row["measure"], *(f"{k}={v}" for k, v in row["arguments"].items())])


def _line(text: str) -> str:
    return " ".join(text.split()).replace("|", "/")[-200:]
