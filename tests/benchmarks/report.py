"""Results -> a page of tables for the documentation, and a plot."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import matplotlib

from tests.benchmarks.cases import BATCHES, DM_CONTROL, GROUPS, ORIGINAL, TASKS

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Row = dict[str, Any]


def write(file: Path) -> None:
    """Writes the page and the plot that belong to the results in ``file``."""
    kept = json.loads(file.read_text())
    known = {case.key for cases in GROUPS.values() for case in cases()}
    rows = [row for key, row in kept["cases"].items() if key in known]
    plotted = plot(rows, file.with_suffix(".png"))
    part = file.with_suffix(".md.part")
    part.write_text(page(kept["machines"], rows, file.stem, plotted))
    part.replace(file.with_suffix(".md"))


def page(machines: dict[str, Row], rows: list[Row], name: str, plotted: bool) -> str:
    """The page, in Markdown."""
    parts = [
        f"# Measurements: {name}",
        "Written by `pixelbrax bench`. Medians of at least five repetitions of half a second or "
        "more, unless a part says otherwise; compilation is apart, every call is waited for, "
        "actions are drawn, and episodes begin anew. Each case has a process of its own.",
        *(_machine(machine) for machine in machines.values()),
    ]
    if plotted:
        parts.append(f"![Steps per second over the number of environments]({name}.png)")
    for group in GROUPS:
        of_group = [row for row in rows if row["group"] == group]
        if of_group:
            dates = sorted({row["date"][:10] for row in of_group})
            command = f"`pixelbrax bench --only {group}`, {' and '.join(dates)}. {NOTES[group]}"
            parts += [f"## {group.capitalize()}", command, TABLES[group](of_group)]
    missing = [row for row in rows if row["status"] != "ok"]
    if missing:
        lines = [(_name(row), row["status"], _line(row["why"])) for row in missing]
        parts += ["## Not measured", _table(("case", "", "why"), lines)]
    return "\n\n".join(parts) + "\n"


NOTES = {
    "renderer": "From link poses to packed pixels, without physics.",
    "startup": "16 environments behind Gymnasium; one sample each. `gymnasium` and PixelBrax are "
    "imported first, JAX and Brax when the environment is made.",
    "adapters": "The ratio is that to the JAX loop with the same autoreset mode, which waits for "
    "each step: medians over rounds, in which each runs 8 to 100 steps in one process, with "
    "bootstrap intervals of 95 %.",
    "distractors": "With a bank of 60 clips of 70 frames. Ratios are to the speed without: medians "
    "over rounds, in which all take a turn of 1 to 100 steps in one process, with bootstrap "
    "intervals of 95 %.",
    "clips": "Images of 854 x 480, as many as the training split of DAVIS-2017 has at most, just "
    "written and so still in memory; one sample each.",
    "original": "A compiled loop of ours in the settings in which the speed of the original is "
    "known; that was measured apart, on two cores of an AMD EPYC whose vectors were not noted.",
    "peers": "All hand NumPy arrays to Python. Tasks are of the same class, not the same: bodies, "
    "control steps and simulators differ. OpenGL peers draw textures and shadows, which we do not, "
    "and would be faster with a GPU; this compares what a machine without one can do. MuJoCo Warp "
    "draws the same model in the same pose from our camera, without textures and shadows.",
    "devices": "Emulated devices share the cores of the machine: the first table shows what is "
    "where, and no speed. Ideal is the speed of one device on one core times the number of cores.",
    "batches": "A compiled loop over steps. Ratios are to the first line of a task: medians over "
    "rounds, in which all take a turn of 16,000 environment steps in one process, with bootstrap "
    "intervals of 95 %.",
    "sizes": "",
    "environments": "A compiled loop over steps; nothing leaves it.",
}
"""What a part shows and what it does not."""


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


def _table(heads: Iterable[str], lines: Iterable[Iterable[Any]]) -> str:
    heads = list(heads)
    rows = [heads, ["---"] * len(heads), *([str(cell) for cell in line] for line in lines)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def number(value: float | None) -> str:
    """Three significant digits, thousands apart."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    digits = 2 - math.floor(math.log10(abs(value)))
    rounded = round(value, digits)
    return f"{rounded:,.{max(0, digits)}f}"


def _ok(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["status"] == "ok"]


def _of(rows: list[Row], measure: str, **arguments: Any) -> Row | None:
    for row in rows:
        if row["measure"] == measure and arguments.items() <= row["arguments"].items():
            return row
    return None


def _value(row: Row | None, name: str) -> float | None:
    return row["values"][name] if row is not None and row["status"] == "ok" else None


def _cell(row: Row | None, name: str) -> str:
    if row is None:
        return "not yet"
    return number(row["values"][name]) if row["status"] == "ok" else str(row["status"])


def _ratio(above: float | None, below: float | None) -> str:
    return number(above / below) if above and below else "-"


def _gigabytes(row: Row | None) -> str:
    if row is None or row["status"] != "ok":
        return "-"
    device, host = row["peak_bytes"]["device"], row["peak_bytes"]["host"]
    return number((device or host) / 1e9)


def _renderer(rows: list[Row]) -> str:
    def line(row: Row) -> list[str]:
        values, options = row["values"], dict(row["arguments"])
        num_envs = options.pop("num_envs")
        options.pop("task")
        return [
            ", ".join(f"{k}={v}" for k, v in options.items()) or "default",
            str(num_envs),
            number(values["frames_per_second"]),
            number(values["compile_seconds"]),
            number(values["temporary_bytes"] / values["output_bytes"]),
            number(values["operations_per_frame"] / 1e6),
        ]

    heads = (
        "Ant",
        "environments",
        "frames/s",
        "compilation, s",
        "temporaries / output",
        "million operations / frame",
    )
    return _table(heads, map(line, _ok(rows)))


def _environments(rows: list[Row]) -> str:
    lines = []
    for task, title in TASKS.items():
        for num_envs in BATCHES:
            where = {"task": task, "num_envs": num_envs}
            state = _of(rows, "throughput.scan", **where, obs_mode="state")
            pixels = _of(rows, "throughput.scan", **where, obs_mode="pixels")
            frames = _of(rows, "throughput.renderer", **where)
            if state or pixels or frames:
                speed = _value(pixels, "steps_per_second")
                held = _value(pixels, "bytes_per_env")
                lines.append(
                    [
                        title,
                        num_envs,
                        _cell(pixels, "steps_per_second"),
                        _cell(state, "steps_per_second"),
                        _ratio(speed, _value(state, "steps_per_second")),
                        _cell(frames, "frames_per_second"),
                        _cell(pixels, "compile_seconds"),
                        number(held / 1e3 if held else None),
                        _gigabytes(pixels),
                    ]
                )
    heads = (
        "task",
        "environments",
        "pixels, steps/s",
        "state only",
        "pixels / state",
        "renderer, frames/s",
        "compilation, s",
        "kB / environment",
        "peak memory, GB",
    )
    return _table(heads, lines)


def _sizes(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        if row["measure"] == "throughput.scan":
            frames = _of(rows, "throughput.renderer", **row["arguments"])
            lines.append(
                [
                    TASKS[row["arguments"]["task"]],
                    row["arguments"]["num_envs"],
                    _cell(row, "steps_per_second"),
                    _cell(frames, "frames_per_second"),
                ]
            )
    return _table(("64 x 64", "environments", "pixels, steps/s", "renderer, frames/s"), lines)


def _original(rows: list[Row]) -> str:
    lines = []
    for task, num_envs, theirs in ORIGINAL:
        row = _of(rows, "throughput.scan", task=task, num_envs=num_envs)
        ours = _value(row, "steps_per_second")
        cells = (_cell(row, "steps_per_second"), theirs, _ratio(ours, theirs))
        lines.append((TASKS[task], num_envs, *cells))
    return _table(("task", "environments", "steps/s", "original", "ratio"), lines)


def _interleaved(*columns: str) -> Callable[[list[Row]], str]:
    """A table of a comparison of interleaved runs.

    Args:
        columns: what tells its lines apart, by their names in the case's arguments or values.
    """

    def table(rows: list[Row]) -> str:
        lines = [
            [
                TASKS[row["arguments"]["task"]],
                *({**row["arguments"], **value}[column] for column in columns),
                number(value["steps_per_second"]),
                f"{value['ratio']:.2f}",
                " to ".join(f"{bound:.2f}" for bound in value["interval"]),
                value["runs"],
            ]
            for row in _ok(rows)
            for value in row["values"]
        ]
        names = {"num_envs": "environments", "autoreset_mode": "autoreset"}
        heads = ("task", *(names.get(column, column) for column in columns))
        return _table((*heads, "steps/s", "ratio", "interval", "rounds"), lines)

    return table


def _startup(rows: list[Row]) -> str:
    rows = _ok(rows)
    stages = list(rows[0]["values"]["seconds"]) if rows else []
    lines = [
        [row["arguments"]["cache"], *(f"{row['values']['seconds'][s]:.1f}" for s in stages)]
        for row in rows
    ]
    return _table(("compilation cache", *(f"{stage}, s" for stage in stages)), lines)


def _clips(rows: list[Row]) -> str:
    lines = [
        [
            number(row["values"]["frames"]),
            number(row["values"]["file_bytes"] / 1e6),
            number(row["values"]["bank_bytes"] / 1e6),
            *(number(seconds) for seconds in row["values"]["seconds"].values()),
        ]
        for row in _ok(rows)
    ]
    stages = (f"{stage}, s" for row in _ok(rows)[:1] for stage in row["values"]["seconds"])
    return _table(("frames", "MB of files", "MB on the device", *stages), lines)


def _devices(rows: list[Row]) -> str:
    lines = [
        [
            row["arguments"]["num_devices"],
            row["arguments"]["num_envs"],
            number(row["values"]["steps_per_second"]),
            number(row["values"]["bytes_on_a_device"] / 1e6),
        ]
        for row in _ok(rows)
        if row["measure"] == "throughput.sharded"
    ]
    stepping = _table(("devices", "environments", "steps/s", "MB on a device"), lines)
    alone = _value(_of(rows, "scaling.training", num_devices=1, cores=1), "steps_per_second")
    lines = []
    for row in _ok(rows):
        if row["measure"] == "scaling.training":
            where, speed = row["arguments"], row["values"]["steps_per_second"]
            share = _ratio(speed, alone and alone * where["cores"])
            compilation = number(row["values"]["compile_seconds"])
            lines.append(
                [
                    where["num_devices"],
                    where["cores"],
                    where["num_envs"],
                    number(speed),
                    share,
                    compilation,
                ]
            )
    heads = ("devices", "cores", "environments", "steps/s", "of ideal", "compilation, s")
    training = f"\n\nTraining, PPO's preset `ci`:\n\n{_table(heads, lines)}" if lines else ""
    return stepping + training


def _peers(rows: list[Row]) -> str:
    lines = []
    for task, title in TASKS.items():
        of_task = [row for row in rows if row["arguments"]["task"] == task]
        ours = _of(of_task, "throughput.gymnasium", num_envs=256)
        speed = _value(ours, "steps_per_second")
        for row in of_task:
            if row["measure"] in _RENDERERS:
                continue
            values = row.get("values", {})
            theirs = values.get("steps_per_second")
            who, count = _who(row, title)
            dt = values.get("control_dt")
            lines.append(
                [
                    who,
                    count,
                    number(1e3 * dt) if dt else "",
                    number(theirs) if theirs else row["status"],
                    _ratio(speed, theirs),
                    values.get("opengl", ""),
                ]
            )
    heads = (
        "who",
        "environments",
        "control step, ms",
        "steps/s",
        "PixelBrax at 256 is faster by",
        "OpenGL",
    )
    environments = _table(heads, lines)
    lines = []
    for row in rows:
        if row["measure"] == "peers.mujoco_warp_renderer":
            where = row["arguments"]
            ours = _of(rows, "throughput.renderer", **where)
            cells = [_cell(ours, "frames_per_second"), _cell(row, "frames_per_second")]
            ratio = _ratio(_value(ours, "frames_per_second"), _value(row, "frames_per_second"))
            lines.append([where["size"], where["num_envs"], *cells, ratio])
    heads = ("pixels", "environments", "PixelBrax, frames/s", "MuJoCo Warp, frames/s", "ratio")
    return f"{environments}\n\nFrames of Ant:\n\n{_table(heads, lines)}\n\n{_peer_versions(rows)}"


_RENDERERS = ("throughput.renderer", "peers.mujoco_warp_renderer")


def _who(row: Row, title: str) -> tuple[str, str]:
    values = row.get("values", {})
    name = row["measure"].split(".")[1]
    if name == "gymnasium":
        return f"PixelBrax {title}, Gymnasium", str(row["arguments"]["num_envs"])
    if name == "dm_control_envs":
        processes = row["arguments"]["processes"]
        how = "SubprocVecEnv" if processes else "alone"
        count = values.get("processes", processes) or 1
        return f"DM Control {row['arguments']['domain']}, {how}", str(count)
    if name == "gymnasium_envs":
        return f"Gymnasium {title}-v5, AsyncVectorEnv", str(values.get("processes", ""))
    return f"EnvPool {title}-v5", str(values.get("num_envs", ""))


def _peer_versions(rows: list[Row]) -> str:
    # Each peer has an environment of its own: two may have different versions of a library.
    versions = {
        f"{name} {version}"
        for row in _ok(rows)
        for name, version in row["values"].get("versions", {}).items()
    }
    return f"Peers' versions: {', '.join(sorted(versions))}."


TABLES: dict[str, Callable[[list[Row]], str]] = {
    "renderer": _renderer,
    "startup": _startup,
    "adapters": _interleaved("num_envs", "autoreset_mode", "adapter"),
    "distractors": _interleaved("num_envs", "distractors"),
    "clips": _clips,
    "original": _original,
    "peers": _peers,
    "devices": _devices,
    "batches": _interleaved("num_envs"),
    "sizes": _sizes,
    "environments": _environments,
}


def plot(rows: list[Row], path: Path) -> bool:
    """Steps per second over the number of environments, one panel a task.

    It is Figure 2 of arXiv 2502.00021 redrawn, with state alone and DM Control beside it.

    Returns:
        Whether there was anything to plot.
    """
    rows = [row for row in _ok(rows) if row["group"] in ("environments", "peers")]
    measured = {r["arguments"]["task"] for r in rows if r["group"] == "environments"}
    if not measured:
        return False
    tasks = {task: title for task, title in TASKS.items() if task in measured}
    figure, panels = plt.subplots(
        1,
        len(tasks),
        figsize=(1 + 3 * len(tasks), 3.6),
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for panel, (task, title) in zip(panels[0], tasks.items(), strict=True):
        of_task = [row for row in rows if row["arguments"].get("task") == task]
        for obs_mode, label in (("state", "state only"), ("pixels", "84 x 84 pixels")):
            points = [
                (row["arguments"]["num_envs"], row["values"]["steps_per_second"])
                for row in of_task
                if row["arguments"].get("obs_mode") == obs_mode
            ]
            panel.loglog(*_columns(points), "o-", label=label)
        points = [
            (max(1, row["values"]["processes"]), row["values"]["steps_per_second"])
            for row in of_task
            if row["measure"] == "peers.dm_control_envs"
        ]
        if points:
            label = f"DM Control {DM_CONTROL[task]}, pixels"
            panel.loglog(*_columns(points), "s--", label=label)
        panel.set(title=title, xlabel="environments")
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    panels[0, 0].set_ylabel("steps / s")
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return True


def _columns(points: list[tuple[int, float]]) -> tuple[list[int], list[float]]:
    points = sorted(points)
    return [x for x, _ in points], [y for _, y in points]
