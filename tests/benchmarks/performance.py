"""Draws tables of performance.md, measurements.md and accelerators.md from what is kept.

python -m tests.benchmarks.performance
"""

from __future__ import annotations

import json
from pathlib import Path

from pixelbrax_gym.bench.ahead import tables as compiled
from pixelbrax_gym.bench.ahead.case import PROGRAMS
from pixelbrax_gym.bench.cases import TASKS
from pixelbrax_gym.bench.tables import cell, find, number, ratio, table, title, value
from tests.benchmarks.pages import redraw

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "performance.md"
FORMS_PAGE = DOCS / "measurements.md"
LEFT_OUT = {
    "card",
    "kernels",
    "longest chain",
    "loops of unknown length",
    "output, MB",
    "registers",
}
"""Columns of the report on programs that the page does without."""
PROGRAMS_PAGE = DOCS / "accelerators.md"
ADAPTERS = {
    "Gymnasium, jax": '`gymnasium.make_vec`, `output="jax"`',
    "Gymnasium, numpy": '`gymnasium.make_vec`, `output="numpy"`',
    "Gymnasium, torch": '`gymnasium.make_vec`, `output="torch"`',
    "TorchRL": "TorchRL's collectors: `step_and_maybe_reset`",
    "Stable-Baselines3": "Stable-Baselines3's `VecEnv`",
}
DISTRACTORS = {
    "color, each frame": "color, for a frame",
    "color, each material": "color, for each material",
    "video overlay": "video over the image",
    "video background": "video as background",
    "camera": "camera",
    "all three": "all three",
}
PEERS = (
    ("DM Control's quadruped, alone", "peers.dm_control_envs", {"processes": 0}),
    (
        "DM Control's quadruped, SB3's `SubprocVecEnv`, 32 processes",
        "peers.dm_control_envs",
        {"processes": 32},
    ),
    ("Gymnasium's Ant-v5, `AsyncVectorEnv`, 2 processes", "peers.gymnasium_envs", {}),
    ("EnvPool's Ant-v5 with pixels", "peers.envpool_envs", {}),
)


def rows_of(machine: str, group: str) -> list[dict]:
    """Outcomes of a group: ``machine`` is a file's name without its ending."""
    kept = json.loads((DOCS / "benchmarks" / f"{machine}.json").read_text("utf-8"))
    return [row for row in kept["cases"].values() if row["group"] == group]


def environments() -> str:
    """Steps per second over the number of environments."""
    rows, lines = rows_of("cpu-avx512", "environments"), []
    for task in TASKS:
        pixels = [
            find(rows, "throughput.scan", task=task, num_envs=count, obs_mode="pixels")
            for count in (1, 100, 1000)
        ]
        state = find(rows, "throughput.scan", task=task, num_envs=1000, obs_mode="state")
        frames = find(rows, "throughput.renderer", task=task, num_envs=1000)
        speeds = [cell(row, "steps_per_second") for row in (*pixels, state)]
        lines.append([title(task), *speeds, cell(frames, "frames_per_second")])
    heads = ("task", "1 environment", "100", "1000", "1000, state alone", "renderer alone")
    return table(heads, lines)


def peers() -> str:
    """Ant beside others."""
    rows = [row for row in rows_of("cpu-avx2", "peers") if row["arguments"]["task"] == "ant"]
    ours = find(rows, "throughput.gymnasium", num_envs=256)
    lines = [["PixelBrax, `gymnasium.make_vec`", cell(ours, "steps_per_second"), ""]]
    for who, measure, arguments in PEERS:
        theirs = find(rows, measure, **arguments)
        both = value(ours, "steps_per_second"), value(theirs, "steps_per_second")
        lines.append([who, cell(theirs, "steps_per_second"), ratio(*both)])
    return table(("who", "steps per second", "PixelBrax is faster by"), lines)


def adapters() -> str:
    """What an adapter costs."""
    return _ratios("adapters.compare", "adapter", "adapters", ADAPTERS, (256, 1))


def distractors() -> str:
    """What distractors cost."""
    return _ratios("distractors.compare", "distractors", "distractors", DISTRACTORS, (256, 1024))


def _ratios(
    measure: str, column: str, group: str, names: dict[str, str], counts: tuple[int, ...]
) -> str:
    rows = rows_of("cpu-avx512", group)
    found = {}
    for count in counts:
        row = find(rows, measure, task="ant", num_envs=count)
        found[count] = {line[column]: line["ratio"] for line in row["values"]}
    lines = [
        [text, *(f"{found[count][name]:.2f}" for count in counts)] for name, text in names.items()
    ]
    heads = [f"{count} environment{'s' if count > 1 else ''}" for count in counts]
    return table((column, *heads), lines)


def forms(area: str) -> str:
    """Forms of the same program, and how fast they were beside another."""
    kept = json.loads((DOCS / "benchmarks" / "forms.json").read_text("utf-8"))["rows"]
    lines = []
    for row in (row for row in kept if row["area"] == area):
        speed, low, high = (row[name] and number(row[name]) for name in ("ratio", "low", "high"))
        interval = f" ({low} to {high})" if low else ""
        about = (row["form"], row["against"], row["where"])
        lines.append([*about, f"{speed}{interval}", "yes" if row["kept"] else ""])
    return table(("form", "against", "where", "speed", "kept"), lines)


def forms_tables() -> dict[str, str]:
    """All of the contributors' page's tables, by name."""
    return {area: f"{forms(area)}\n" for area in ("physics", "renderer")}


def programs_tables() -> dict[str, str]:
    """Tables of programs that are compiled and not run, by name.

    Of the GPUs the H100 alone, of many environments Ant alone, and no steps in a loop.
    """
    cards = [
        row
        for row in rows_of("programs", "gpu-program")
        if row["arguments"]["card"] == "H100" and row["arguments"]["program"] != "scan"
        if row["arguments"]["num_envs"] == 1024 or row["arguments"]["task"] == "ant"
    ]
    cards.sort(key=_place)
    chips = sorted(rows_of("programs", "tpu-program"), key=_place)
    return {
        "gpu-programs": f"{compiled.gpu(cards, LEFT_OUT)}\n",
        "tpu-programs": f"{compiled.tpu(chips)}\n",
    }


def _place(row: dict) -> tuple[int, int, int]:
    about = row["arguments"]
    tasks = ("inverted_pendulum", *TASKS)
    return about["num_envs"], tasks.index(about["task"]), PROGRAMS.index(about["program"])


def tables() -> dict[str, str]:
    """All of the page's tables, by name."""
    drawings = (environments, peers, adapters, distractors)
    return {draw.__name__: f"{draw()}\n" for draw in drawings}


if __name__ == "__main__":
    redraw(PAGE, tables())
    redraw(FORMS_PAGE, forms_tables())
    redraw(PROGRAMS_PAGE, programs_tables())
