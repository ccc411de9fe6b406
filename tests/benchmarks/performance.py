"""Tables and figures of speed, from the results that are kept in docs/benchmarks."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench.tables import number, table
from tests.benchmarks.ahead import tables as compiled
from tests.benchmarks.ahead.case import MUJOCO_STEPS, PROGRAMS, TRAINING
from tests.benchmarks.ahead.targets import LAUNCH_SECONDS
from tests.benchmarks.case import TASKS
from tests.benchmarks.original import ORIGINAL
from tests.benchmarks.tables import cell, find, ratio, title, value

DOCS = Path(__file__).parents[2] / "docs"
LEFT_OUT = {
    "card",
    "kernels",
    "longest chain",
    "loops of unknown length",
    "output, MB",
    "registers",
}
"""Columns of the report on programs that the page does without."""
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


@cache
def read(name: str) -> Any:
    """A JSON file in docs."""
    return json.loads((DOCS / name).read_text("utf-8"))


def rows_of(machine: str, group: str) -> list[dict]:
    """Outcomes of a group: ``machine`` is a file's name without its ending."""
    cases = read(f"benchmarks/{machine}.json")["cases"]
    return [row for row in cases.values() if row["group"] == group]


def measured(machine: str, group: str, measure: str, **arguments: Any) -> Any:
    """Values of an outcome."""
    row = find(rows_of(machine, group), measure, **arguments)
    assert row is not None, (machine, group, measure, arguments)
    return row["values"]


def span(values: Iterable[float], form: str = "{:.2f}") -> str:
    """The least and the largest."""
    values = list(values)
    return f"{form.format(min(values))} to {form.format(max(values))}"


def rounded(value: float, digits: int) -> str:
    """So many significant digits, thousands apart."""
    return f"{float(f'{value:.{digits - 1}e}'):,.0f}"


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
    return table(("who", "steps per second", "PixelBrax, times as fast"), lines)


def comparison(group: str, column: str, names: dict[str, str], counts: tuple[int, ...]) -> str:
    """Ratios of speed of Ant, interleaved, over the number of environments."""
    found = {count: _lines(group, column, count) for count in counts}
    lines = [
        [text, *(f"{found[count][name]['ratio']:.2f}" for count in counts)]
        for name, text in names.items()
    ]
    heads = [f"{count} environment{'s' if count > 1 else ''}" for count in counts]
    return table((column, *heads), lines)


def _lines(
    group: str, column: str, num_envs: int, machine: str = "cpu-avx512"
) -> dict[str, dict[str, Any]]:
    row = measured(machine, group, f"{group}.compare", task="ant", num_envs=num_envs)
    # The loop beside TorchRL has another autoreset mode; the first is meant.
    return {line[column]: line for line in reversed(row)}


def programs() -> str:
    """Programs for an H100: 1024 environments of each task, and Ant's 8192."""
    shown = [
        find(
            rows_of("programs", "gpu-program"),
            "compiling.gpu",
            **{"task": task, "num_envs": num_envs, "program": program, "card": "H100"},
        )
        for task, num_envs in (*((task, 1024) for task in TASKS), ("ant", 8192))
        for program in PROGRAMS
        if program != "scan"
    ]
    return compiled.gpu(shown, LEFT_OUT)


def these_programs(wanted: list[dict[str, Any]]) -> str:
    """Programs for an H100 with these arguments."""
    rows = rows_of("programs", "gpu-program")
    shown = [next(row for row in rows if row["arguments"] == where) for where in wanted]
    return compiled.gpu(shown, LEFT_OUT)


def tpu_programs() -> str:
    """Programs for a TPU."""
    return compiled.tpu(
        [
            row
            for row in rows_of("programs", "tpu-program")
            if row["arguments"]["task"] in ("inverted_pendulum", "ant")
        ]
    )


def ant() -> float:
    """Steps per second of 256 Ants, as peers are measured."""
    where = {"task": "ant", "num_envs": 256}
    return measured("cpu-avx2", "peers", "throughput.gymnasium", **where)["steps_per_second"]


def ants() -> str:
    """Steps per second of 256 Ants through Gymnasium, over all runs, with NumPy or torch."""
    speeds = [
        measured(machine, "peers", "throughput.gymnasium", task="ant", num_envs=256)[
            "steps_per_second"
        ]
        for machine in ("cpu-avx2", "cpu-avx512")
    ]
    for machine in ("cpu-avx2", "cpu-avx512"):
        lines = _lines("adapters", "adapter", 256, machine)
        speeds += [lines[f"Gymnasium, {kind}"]["steps_per_second"] for kind in ("numpy", "torch")]
    return " to ".join(f"{round(speed, -2):,.0f}" for speed in (min(speeds), max(speeds)))


def dm_control() -> float:
    """The same of DM Control's quadruped in 32 processes."""
    where = {"task": "ant", "processes": 32}
    return measured("cpu-avx2", "peers", "peers.dm_control_envs", **where)["steps_per_second"]


def frames(peer: str) -> str:
    """Frames per second of 256 Ants."""
    row = measured("cpu-avx2", "peers", peer, task="ant", num_envs=256, size=84)
    return number(row["frames_per_second"])


def distractor_ratios() -> str:
    """Speed of Ant with distractors over that without."""
    return span(
        line["ratio"]
        for num_envs in (256, 1024)
        for name, line in _lines("distractors", "distractors", num_envs).items()
        if not name.startswith("none")
    )


def batches(num_envs: int) -> str:
    """Speed with so many environments over that with a hundred."""
    return span(
        line["ratio"]
        for task in TASKS
        for line in measured("cpu-avx512", "batches", "batches.compare", task=task)
        if line["num_envs"] == num_envs
    )


def held() -> str:
    """Kilobytes of an environment with pixels."""
    rows = rows_of("cpu-avx512", "environments")
    pixels = [row for row in rows if row["arguments"].get("obs_mode") == "pixels"]
    return span((row["values"]["bytes_per_env"] / 1e3 for row in pixels), "{:.0f}")


def to_original() -> str:
    """How many times as fast as the original."""
    ratios = (
        measured("cpu-avx2", "original", "throughput.scan", task=task, num_envs=num_envs)[
            "steps_per_second"
        ]
        / theirs
        for task, num_envs, theirs in ORIGINAL
    )
    return " to ".join(rounded(x, 2) for x in sorted(ratios)[::4])


def startup(cache: str, stage: str = "import to first step") -> float:
    """Seconds of a stage."""
    return measured("cpu-avx512", "startup", "startup.first_frame", cache=cache)["seconds"][stage]


def training(num_devices: int, cores: int) -> float:
    """Steps per second of training on devices with so many cores together."""
    where = {"num_devices": num_devices, "cores": cores}
    return measured("cpu-avx512", "devices", "scaling.training", **where)["steps_per_second"]


def h100(task: str, program: str) -> dict[str, Any]:
    """What the compiler for an H100 made of a program."""
    where = {"task": task, "program": program, "num_envs": 1024, "card": "H100"}
    return measured("programs", "gpu-program", "compiling.gpu", **where)


def traffic(program: str) -> list[float]:
    """Bytes moved over bytes of frames, by task."""
    rows = [h100(task, program) for task in TASKS]
    return [(row["read_bytes"] + row["written_bytes"]) / row["output_bytes"] for row in rows]


def pixel_launches() -> str:
    """Launches that pixels add to a step."""
    steps = ((h100(task, "step"), h100(task, "state step")) for task in TASKS)
    return " or ".join(sorted({str(step["launches"] - state["launches"]) for step, state in steps}))


def tpu_megabytes(name: str) -> str:
    """Megabytes of drawing Ants on a TPU."""
    where = {"task": "ant", "program": "renderer"}
    return f"{measured('programs', 'tpu-program', 'compiling.tpu', **where)[name] / 1e6:.0f}"


README = {
    "ants": ants,
    "ant": lambda: number(ant()),
    "dm-control": lambda: f"{dm_control():.0f}",
    "distractors": distractor_ratios,
    "original-ant": lambda: str(next(row[2] for row in ORIGINAL if row[0] == "ant")),
    "to-original": to_original,
}

PERFORMANCE = {
    "environments": environments,
    "peers": peers,
    "adapters": partial(comparison, "adapters", "adapter", ADAPTERS, (256, 1)),
    "distractors": partial(comparison, "distractors", "distractors", DISTRACTORS, (256, 1024)),
    "ants": ants,
    "batches-1000": partial(batches, 1000),
    "batches-10": partial(batches, 10),
    "kilobytes": held,
    "frames-warp": partial(frames, "peers.mujoco_warp_renderer"),
    "frames": partial(frames, "throughput.renderer"),
    "original": lambda: span((row[2] for row in ORIGINAL), "{:.0f}"),
    "to-original": to_original,
    "scan": lambda: f"{_lines('adapters', 'adapter', 1)['JAX scan']['ratio']:.1f}",
    "startup": lambda: f"{startup('none'):.0f}",
    "startup-warm": lambda: f"{startup('warm'):.0f}",
    "startup-again": lambda: f"{startup('none', 'make, reset and step once more'):.2f}",
    "training-1": lambda: rounded(training(1, 1), 2),
    "training-2": lambda: rounded(training(2, 2), 2),
    "training-gain": lambda: f"{training(2, 2) / training(1, 1):.1f}",
    "training-alone": lambda: rounded(training(1, 2), 2),
}

ACCELERATORS = {
    "traffic": lambda: span(traffic("renderer")),
    "traffic-plain": lambda: f"{max(traffic('plain renderer')):.0f}",
    "pixel-launches": pixel_launches,
}
COMPILED_PROGRAMS = {
    "gpu-programs": programs,
    "mujoco-programs": partial(these_programs, MUJOCO_STEPS),
    "training-programs": partial(these_programs, TRAINING),
    "tpu-programs": tpu_programs,
    "launch-seconds": lambda: f"{LAUNCH_SECONDS * 1e6:.1f}",
    "tpu-moved": partial(tpu_megabytes, "accessed_bytes"),
    "tpu-frames": partial(tpu_megabytes, "output_bytes"),
}
