"""Write results as a page of tables and a plot of steps per second."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from pixelbrax_gym.bench.case import Group, Row
from pixelbrax_gym.bench.tables import succeeded, table, title

_HEADING = (
    "# Measurements",
    "Medians of at least five repetitions of half a second or more, unless a part says "
    "otherwise. Times exclude compilation and include waiting for every result. Actions are "
    "random, and episodes reset automatically. Each case runs in a separate process.",
)


def write(file: Path, groups: Mapping[str, Group]) -> None:
    """Write the page of the results in ``file`` beside it, and the plot if matplotlib is there."""
    kept = json.loads(file.read_text("utf-8"))
    picture = file.with_suffix(".png")
    plotted = find_spec("matplotlib") is not None and plot(_rows(kept, groups), picture)
    if not plotted:
        picture.unlink(missing_ok=True)
    part = file.with_suffix(".md.part")
    part.write_text(page(kept, groups, picture.name if plotted else None), "utf-8")
    part.replace(file.with_suffix(".md"))


def page(kept: Mapping[str, Row], groups: Mapping[str, Group], picture: str | None) -> str:
    """Return the results as a page in Markdown that includes the plot ``picture``."""
    rows = _rows(kept, groups)
    used = {row["machine"] for row in rows}
    parts = [
        *_HEADING,
        *(_machine(machine) for name, machine in kept["machines"].items() if name in used),
    ]
    if picture:
        parts.append(f"![Steps per second over the number of environments]({picture})")
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


def plot(rows: list[Row], path: Path) -> bool:
    """Plot steps per second over the number of environments; return False if there are none."""
    chosen = [row for row in succeeded(rows) if row["group"] == "environments"]
    tasks = list(dict.fromkeys(row["arguments"]["task"] for row in chosen))
    if not tasks:
        return False
    # A value left by another tool would make the import of matplotlib fail.
    os.environ["MPLBACKEND"] = "Agg"
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1,
        len(tasks),
        figsize=(1 + 3 * len(tasks), 3.6),
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for panel, task in zip(panels[0], tasks, strict=True):
        for obs_mode, label in (("state", "state only"), ("pixels", "84 x 84 pixels")):
            points = sorted(
                (row["arguments"]["num_envs"], row["values"]["steps_per_second"])
                for row in chosen
                if row["arguments"]["task"] == task and row["arguments"].get("obs_mode") == obs_mode
            )
            panel.loglog([x for x, _ in points], [y for _, y in points], "o-", label=label)
        panel.set(title=title(task), xlabel="environments")
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    panels[0, 0].set_ylabel("steps / s")
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return True


def _rows(kept: Mapping[str, Row], groups: Mapping[str, Group]) -> list[Row]:
    """Return the outcomes of the groups' cases."""
    known = {case.key for group in groups.values() for case in group.cases()}
    return [row for key, row in kept["cases"].items() if key in known]


def _machine(machine: Row) -> str:
    versions = ", ".join(f"{name} {v}" for name, v in machine["versions"].items() if v)
    vectors = f" with {machine['vectors']}" if machine["vectors"] else ""
    return (
        f"{machine['device']} ({machine['processor']}{vectors}, {machine['cores']} cores), "
        f"{machine['system']}, Python {machine['python']}; {versions}. "
        f"XLA_FLAGS: `{machine['xla_flags'] or 'none'}`."
    )


def _name(row: Row) -> str:
    return " ".join([row["measure"], *(f"{k}={v}" for k, v in row["arguments"].items())])


def _line(text: str) -> str:
    return " ".join(text.split()).replace("|", "/")[-200:]
