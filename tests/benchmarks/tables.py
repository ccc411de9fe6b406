"""Tables of outcomes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pixelbrax_gym.bench.tables import COMPARED, compared, number, table
from pixelbrax_jax.tasks import TASKS
from tests.benchmarks.case import TASKS as MEASURED
from tests.benchmarks.case import Row
from tests.benchmarks.original import ORIGINAL


def title(task: str) -> str:
    """Return a task's name in its Gymnasium id."""
    return TASKS[task].gymnasium_id.removeprefix("PixelBrax/").removesuffix("-v0")


def succeeded(rows: list[Row]) -> list[Row]:
    """Return the outcomes that have values."""
    return [row for row in rows if row["status"] == "ok"]


def find(rows: list[Row], measure: str, **arguments: Any) -> Row | None:
    """Return the first outcome of a measure whose arguments include these."""
    for row in rows:
        if row["measure"] == measure and arguments.items() <= row["arguments"].items():
            return row
    return None


def value(row: Row | None, name: str) -> Any:
    """Return a value of an outcome; None if it is missing."""
    return row["values"][name] if row is not None and row["status"] == "ok" else None


def cell(row: Row | None, name: str) -> str:
    """Format a value of an outcome, or the reason why it is missing."""
    if row is None:
        return "not yet"
    return number(row["values"][name]) if row["status"] == "ok" else str(row["status"])


def ratio(above: float | None, below: float | None) -> str:
    """Format a quotient; a hyphen if a value is unknown."""
    return number(above / below) if above and below else "-"


def renderer(rows: list[Row]) -> str:
    """Return the table of the renderer's frames per second."""

    def line(row: Row) -> list[str]:
        options = {k: v for k, v in row["arguments"].items() if k not in ("task", "num_envs")}
        return [
            ", ".join(f"{k}={v}" for k, v in options.items()) or "default",
            str(row["arguments"]["num_envs"]),
            number(row["values"]["frames_per_second"]),
            number(row["values"]["compile_seconds"]),
        ]

    heads = ("Ant", "environments", "frames/s", "compilation, s")
    return table(heads, map(line, succeeded(rows)))


def environments(rows: list[Row]) -> str:
    """Return the table of steps per second with and without pixels."""
    lines = []
    for task in dict.fromkeys(row["arguments"]["task"] for row in rows):
        of_task = [row for row in rows if row["arguments"]["task"] == task]
        for num_envs in sorted({row["arguments"]["num_envs"] for row in of_task}):
            where = {"num_envs": num_envs}
            state = find(of_task, "throughput.scan", **where, obs_mode="state")
            pixels = find(of_task, "throughput.scan", **where, obs_mode="pixels")
            frames = find(of_task, "throughput.renderer", **where)
            both = (value(row, "steps_per_second") for row in (pixels, state))
            held = value(pixels, "bytes_per_env")
            peak = (pixels or {}).get("peak_bytes") or {"device": None, "host": None}
            lines.append(
                [
                    title(task),
                    num_envs,
                    cell(pixels, "steps_per_second"),
                    cell(state, "steps_per_second"),
                    ratio(*both),
                    cell(frames, "frames_per_second") if frames else "-",
                    cell(pixels, "compile_seconds"),
                    ratio(held, 1e3),
                    ratio(peak["device"] or peak["host"], 1e9),
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
    return table(heads, lines)


def interleaved(*columns: str) -> Callable[[list[Row]], str]:
    """Return a function that formats a comparison with columns for these arguments or values."""

    def draw(rows: list[Row]) -> str:
        lines = [
            [
                title(row["arguments"]["task"]),
                *({**row["arguments"], **values}[column] for column in columns),
                *compared(values),
            ]
            for row in succeeded(rows)
            for values in row["values"]
        ]
        names = {"num_envs": "environments", "autoreset_mode": "autoreset"}
        heads = ("task", *(names.get(column, column) for column in columns))
        return table((*heads, *COMPARED), lines)

    return draw


def original(rows: list[Row]) -> str:
    lines = []
    for task, num_envs, theirs in ORIGINAL:
        row = find(rows, "throughput.scan", task=task, num_envs=num_envs)
        ours = value(row, "steps_per_second")
        cells = (cell(row, "steps_per_second"), theirs, ratio(ours, theirs))
        lines.append((title(task), num_envs, *cells))
    return table(("task", "environments", "steps/s", "original", "ratio"), lines)


def startup(rows: list[Row]) -> str:
    rows = succeeded(rows)
    stages = list(rows[0]["values"]["seconds"]) if rows else []
    lines = [
        [row["arguments"]["cache"], *(f"{row['values']['seconds'][s]:.1f}" for s in stages)]
        for row in rows
    ]
    return table(("compilation cache", *(f"{stage}, s" for stage in stages)), lines)


def devices(rows: list[Row]) -> str:
    alone = value(find(rows, "scaling.training", num_devices=1, cores=1), "steps_per_second")
    lines = []
    for row in succeeded(rows):
        where, values = row["arguments"], row["values"]
        speed = values["steps_per_second"]
        lines.append(
            [
                *(where[name] for name in ("num_devices", "cores", "num_envs")),
                number(speed),
                ratio(speed, alone and alone * where["cores"]),
                number(values["compile_seconds"]),
            ]
        )
    return table(
        ("devices", "cores", "environments", "steps/s", "of ideal", "compilation, s"), lines
    )


def dmc(rows: list[Row]) -> str:
    lines = []
    for task in dict.fromkeys(row["arguments"]["task"] for row in rows):
        ours = find(rows, "dmc.pixels", task=task)
        theirs = find(rows, "peers.dm_control_envs", task=task)
        faster = ratio(value(ours, "steps_per_second"), value(theirs, "steps_per_second"))
        frame = value(ours, "first_frame") or {}
        lines.append(
            [
                f"`{task}`",
                cell(ours, "steps_per_second"),
                cell(theirs, "steps_per_second"),
                faster,
                number(frame.get("without")),
                number(frame.get("with")),
            ]
        )
    heads = (
        "task",
        "PixelBrax, steps/s",
        "dm_control, steps/s",
        "times as fast",
        "first frame, s",
        "with programs kept, s",
    )
    return f"{table(heads, lines)}\n\n{_peer_versions(rows)}"


def looks(rows: list[Row]) -> str:
    lines = []
    for task in dict.fromkeys(row["arguments"]["task"] for row in rows):
        ours = [find(rows, "dmc.with_look", task=task, look=look) for look in ("dmc-plain", "dmc")]
        plain, whole = (value(row, "steps_per_second") for row in ours)
        theirs = find(rows, "peers.dm_control_envs", task=task)
        speeds = [cell(row, "steps_per_second") for row in (*ours, theirs)]
        faster = ratio(whole, value(theirs, "steps_per_second"))
        lines.append([f"`{task}`", *speeds, ratio(whole, plain), faster])
    heads = ["task", "default look", '`look="dmc"`', "dm_control", "dmc / default", "times as fast"]
    return f"{table(heads, lines)}\n\n{_peer_versions(rows)}"


def peers(rows: list[Row]) -> str:
    lines = []
    for task in MEASURED:
        of_task = [row for row in rows if row["arguments"]["task"] == task]
        ours = find(of_task, "throughput.gymnasium", num_envs=256)
        speed = value(ours, "steps_per_second")
        for row in of_task:
            if row["measure"] in _RENDERERS:
                continue
            values = row.get("values", {})
            theirs = values.get("steps_per_second")
            who, count = _who(row)
            dt = values.get("control_dt")
            lines.append(
                [
                    who,
                    count,
                    number(1e3 * dt) if dt else "",
                    number(theirs) if theirs else row["status"],
                    ratio(speed, theirs),
                    values.get("opengl", ""),
                ]
            )
    heads = (
        "who",
        "environments",
        "control step, ms",
        "steps/s",
        "PixelBrax at 256, times as fast",
        "OpenGL",
    )
    environments = table(heads, lines)
    lines = []
    for row in rows:
        if row["measure"] == "peers.mujoco_warp_renderer":
            where = row["arguments"]
            ours = find(rows, "throughput.renderer", **where)
            cells = [cell(ours, "frames_per_second"), cell(row, "frames_per_second")]
            faster = ratio(value(ours, "frames_per_second"), value(row, "frames_per_second"))
            lines.append([where["size"], where["num_envs"], *cells, faster])
    heads = ("pixels", "environments", "PixelBrax, frames/s", "MuJoCo Warp, frames/s", "ratio")
    return f"{environments}\n\nFrames of Ant:\n\n{table(heads, lines)}\n\n{_peer_versions(rows)}"


_RENDERERS = ("throughput.renderer", "peers.mujoco_warp_renderer")


def _who(row: Row) -> tuple[str, str]:
    values, name = row.get("values", {}), title(row["arguments"]["task"])
    measure = row["measure"].split(".")[1]
    if measure == "gymnasium":
        return f"PixelBrax {name}, Gymnasium", str(row["arguments"]["num_envs"])
    if measure == "dm_control_envs":
        processes = row["arguments"]["processes"]
        how = "SubprocVecEnv" if processes else "alone"
        count = values.get("processes", processes) or 1
        return f"DM Control {row['arguments']['domain']}, {how}", str(count)
    if measure == "gymnasium_envs":
        return f"Gymnasium {name}-v5, AsyncVectorEnv", str(values.get("processes", ""))
    return f"EnvPool {name}-v5", str(values.get("num_envs", ""))


def _peer_versions(rows: list[Row]) -> str:
    # Each peer has an environment of its own: two may have different versions of a library.
    versions = {
        f"{name} {version}"
        for row in succeeded(rows)
        for name, version in row["values"].get("versions", {}).items()
    }
    return f"Peers' versions: {', '.join(sorted(versions))}."
