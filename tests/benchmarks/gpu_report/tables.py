"""A report as a page of tables in Markdown, and the plan by group."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pixelbrax_gym.bench.tables import number, table
from tests.benchmarks import report
from tests.benchmarks.case import Group, Row
from tests.benchmarks.gpu_report.plan import HOST_LOOPS, Timed
from tests.benchmarks.tables import cell, interleaved, ratio, succeeded, title

TIMES = (30, 60, 120, 240)
"""Seconds of training at which tables have the return."""


def groups_of(cases: Sequence[Timed]) -> dict[str, Group]:
    """Return the groups of the report with their tables, in the order of the page."""
    return {
        name: Group([case for case in cases if case.group == name], draw, note)
        for name, (draw, note) in _TABLES.items()
    }


def page(machine: Row, rows: Sequence[Row], cases: Sequence[Timed]) -> str:
    """Return the page; at its end is what has not been measured yet."""
    known = {row["key"]: {**row, "machine": ""} for row in rows}
    text = report.page({"machines": {"": machine}, "cases": known}, groups_of(cases))
    heading, _, rest = text.partition("\n")
    parts = [f"{heading} on {machine['device']}", _card(machine) + rest]
    waiting = [case for case in cases if case.key not in known]
    if waiting:
        counts = [(g, sum(case.group == g for case in waiting)) for g in _TABLES]
        parts += ["## Not reached", "The same command goes on with these:"]
        parts.append(table(("part", "cases"), [line for line in counts if line[1]]))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _card(machine: Row) -> str:
    card = machine.get("card")
    if card is None:
        return f"A rehearsal on the CPU, at a small size. {machine['why']}.\n\n"
    return (
        f"{card['name']}, {card['total_gb']:.0f} GB ({card['free_gb']:.0f} free), compute "
        f"capability {card['capability']}, driver {card['driver']}; JAX sees "
        f"{machine['device']!r}. Images are drawn {machine['why']}.\n\n"
    )


def kernel(rows: list[Row]) -> str:
    """Return the table of the checks of the kernel, the worst first."""
    lines = [
        (title(row["arguments"]["task"]), *(text for one in row["values"] for text in _same(one)))
        for row in sorted(succeeded(rows), key=lambda row: min(v["same"] for v in row["values"]))
    ]
    heads = ("task", "pixels alike, %", "most levels apart", "with shadows, %", "levels")
    return table(heads, lines)


def _same(found: Row) -> tuple[str, int]:
    return f"{100 * found['same']:.3f}", found["apart"]


def speeds(rows: list[Row]) -> str:
    """Return the table of steps per second, with a column for each number of environments."""
    batches = sorted({row["arguments"]["num_envs"] for row in rows})
    lines: dict[tuple[str, ...], dict[int, Row]] = {}
    for row in rows:
        where = row["arguments"]
        size = f"{where['size']} x {where['size']}" if where["size"] else "state"
        how = where["policy"] + (", loops by the host" if where["flags"] == HOST_LOOPS else "")
        how += ", MuJoCo Warp" if where["engine"] == "warp" else ""
        lines.setdefault((title(where["task"]), size, how), {})[where["num_envs"]] = row
    heads = ("task", "observation", "policy", *(f"N = {n:,}" for n in batches), "compiled in, s")
    return table(
        heads,
        [
            (
                *name,
                *(cell(line.get(n), "steps_per_second") for n in batches),
                number(max(row.get("prepared_seconds") or 0.0 for row in line.values())),
            )
            for name, line in sorted(lines.items())
        ],
    )


def adapters(rows: list[Row]) -> str:
    """Return the table of the adapters, and a line on shared memory."""
    drawn = []
    for row in succeeded(rows):
        each = [{**row, "values": row["values"]["adapters"]}]
        drawn.append(interleaved("num_envs", "autoreset_mode", "adapter")(each))
        told = {True: "shared without a copy", False: "COPIED"}
        shared = [f"{name}: {told[same]}" for name, same in row["values"]["shared"].items()]
        drawn.append(
            "Pointers in torch and JAX. " + "; ".join(shared or ["torch is missing"]) + "."
        )
    return "\n\n".join(drawn)


def learning(rows: list[Row]) -> str:
    """Return the table of training runs."""
    lines = []
    for row in succeeded(rows):
        where, found = row["arguments"], row["values"]
        points = found["curve"]
        lines.append(
            (
                f"{where['algorithm']}, `{where['preset']}`",
                title(where["task"]),
                *(number(_return_at(points, seconds)) for seconds in TIMES),
                number(points[-1][2] if points else None),
                f"{found['seconds']:.0f}",
                f"{found['steps']:,}",
                number(found["steps_per_second"]),
                number(found["first_update_seconds"]),
            )
        )
    times = (f"return at {seconds} s" for seconds in TIMES)
    heads = ("agent", "task", *times, "at the end", "end, s", "steps", "steps/s", "first update, s")
    return table(heads, lines)


def _return_at(points: list[list[float]], seconds: float) -> float | None:
    """Return the last known return then; None before the first and after the last one."""
    known = [point for point in points if point[0] <= seconds]
    return known[-1][2] if known and points[-1][0] >= seconds else None


def tests(rows: list[Row]) -> str:
    """Return the outcomes of the tests, and the names of those that failed."""
    lines = [
        ", ".join(f"{count} {outcome}" for outcome, count in row["values"]["counts"].items())
        + ("." if row["values"]["finished"] else ", then the time was over.")
        + "".join(f"\n* failed: `{name}`" for name in row["values"]["failed"])
        for row in succeeded(rows)
    ]
    return "\n\n".join(lines)


def renderers(rows: list[Row]) -> str:
    """Return the table of frames per second of all renderers."""
    names = {
        "speeds.frames": "PixelBrax, `{renderer}`",
        "renderers.mjx": "`mjx.render`",
        "renderers.warp": "MuJoCo Warp's `render`",
    }
    ours = {
        _view(row): row["values"]["frames_per_second"]
        for row in succeeded(rows)
        if row["arguments"].get("renderer") == "pallas"
    }
    lines = [
        (
            title(row["arguments"]["task"]),
            row["arguments"]["num_envs"],
            row["arguments"]["size"],
            names[row["measure"]].format(**row["arguments"]),
            number(row["values"]["frames_per_second"]),
            ratio(ours.get(_view(row)), row["values"]["frames_per_second"]),
        )
        for row in succeeded(rows)
    ]
    heads = ("task", "images", "size", "renderer", "frames/s", "ours by the kernel to it")
    return table(heads, lines)


def _view(row: Row) -> tuple[Any, ...]:
    return tuple(row["arguments"][name] for name in ("task", "num_envs", "size"))


_TABLES = {
    "kernel": (
        kernel,
        "The kernel for NVIDIA GPUs against the plain ray-caster, images of five first states. "
        "Alike are pixels that are at most one level of 255 apart; 99.9 % are asked for.",
    ),
    "speeds": (
        speeds,
        "Environment steps per second in one compiled loop, with autoreset and three stacked "
        "frames. The network is DQN's encoder on images and 2 x 256 on states, and its actions are "
        "sampled. The last column is the longest time from the start of a process until it is "
        "compiled, beside others that compile.",
    ),
    "adapters": (
        adapters,
        "The ratio is to the JAX loop with the same autoreset mode, which waits for each step: a "
        "median over rounds with a 95 % bootstrap interval.",
    ),
    "learning": (
        learning,
        "Returns of training episodes, stochastic actions included, over seconds since the start "
        "of training; compiling is a part of the first update.",
    ),
    "tests": (tests, "`tests/gpu`, without what other parts show."),
    "renderers": (
        renderers,
        "The same model, pose and camera, without physics, shadows and textures.",
    ),
}
