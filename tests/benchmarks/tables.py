"""Tables of what is measured besides ``pixelbrax bench``."""

from __future__ import annotations

from pixelbrax_gym.bench.cases import TASKS
from pixelbrax_gym.bench.tables import (
    Row,
    cell,
    find,
    number,
    ratio,
    succeeded,
    table,
    title,
    value,
)
from tests.benchmarks.original import ORIGINAL


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
        "faster by",
        "first frame, s",
        "with programs kept, s",
    )
    return f"{table(heads, lines)}\n\n{_peer_versions(rows)}"


def peers(rows: list[Row]) -> str:
    lines = []
    for task in TASKS:
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
        "PixelBrax at 256 is faster by",
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
