"""What ``pixelbrax bench`` measures: in two and a half minutes, or in full."""

from __future__ import annotations

from collections.abc import Iterator

from pixelbrax_gym.bench import tables
from pixelbrax_gym.bench.ahead import tables as compiled
from pixelbrax_gym.bench.ahead.case import PROGRAMS, AheadCase
from pixelbrax_gym.bench.ahead.targets import CARDS
from pixelbrax_gym.bench.case import Case, Group

TASKS = ("halfcheetah", "walker2d", "ant", "humanoid")
BATCHES = (1, 10, 100, 1000, 4096, 8192)


def renderer() -> Iterator[Case]:
    """The ray-caster alone, as it is used."""
    yield Case("renderer", "throughput.renderer", {"task": "ant", "num_envs": 256})


def renderers() -> Iterator[Case]:
    """The ray-caster alone: its looks, and the size of the image."""
    yield from renderer()
    for options in (
        {"look": "original"},
        {"shadows": True},
        {"size": 64},
        {"renderer": "reference", "num_envs": 8},
    ):
        yield Case("renderer", "throughput.renderer", {"task": "ant", "num_envs": 256, **options})


def few_environments() -> Iterator[Case]:
    """One Ant and a hundred."""
    where = {"task": "ant", "num_envs": 1, "obs_mode": "pixels"}
    yield Case("environments", "throughput.scan", where)
    yield from _environments("ant", 100)


def environments() -> Iterator[Case]:
    """State only, rendering only and pixels, over the number of environments."""
    for task in TASKS:
        for num_envs in BATCHES:
            yield from _environments(task, num_envs)
            where = {"task": task, "num_envs": num_envs}
            yield Case("environments", "throughput.renderer", where)


def _environments(task: str, num_envs: int) -> Iterator[Case]:
    for obs_mode in ("state", "pixels"):
        where = {"task": task, "num_envs": num_envs, "obs_mode": obs_mode}
        yield Case("environments", "throughput.scan", where)


def adapter() -> Iterator[Case]:
    """Every adapter that is installed, of the task that compiles fastest.

    An adapter costs Python's time, whatever the task; nearly all of this case is compilation.
    """
    where = {"task": "inverted_pendulum", "num_envs": 100, "seconds": 6.0}
    yield Case("adapters", "adapters.compare", where)


def adapters() -> Iterator[Case]:
    """Every adapter that is installed."""
    for task, num_envs in (("ant", 256), ("ant", 1), *((task, 1000) for task in TASKS)):
        where = {"task": task, "num_envs": num_envs}
        yield Case("adapters", "adapters.compare", where)


def distractors() -> Iterator[Case]:
    """Pixels with each distractor."""
    for task, num_envs in (("ant", 256), ("ant", 1024), *((task, 1000) for task in TASKS)):
        where = {"task": task, "num_envs": num_envs}
        yield Case("distractors", "distractors.compare", where)


def gpu_programs() -> Iterator[Case]:
    """Programs for NVIDIA GPUs, of which none need be here."""
    for card in CARDS:
        for num_envs in (1024, 8192):
            for task in TASKS:
                for program in PROGRAMS:
                    where = {"task": task, "program": program, "num_envs": num_envs, "card": card}
                    yield AheadCase("gpu-program", "compiling.gpu", where)


def tpu_programs() -> Iterator[Case]:
    """Programs for a TPU, likewise."""
    for task in ("inverted_pendulum", *TASKS):
        for program in ("renderer", "step"):
            where = {"task": task, "program": program, "num_envs": 1024}
            yield AheadCase("tpu-program", "compiling.tpu", where, platform="tpu")


RENDERER_NOTE = "From link poses to packed pixels, without physics."
ADAPTERS_NOTE = (
    "The ratio is that to the JAX loop with the same autoreset mode, which waits for each step: "
    "medians over rounds, in which each runs 8 to 100 steps in one process, with bootstrap "
    "intervals of 95 %."
)
ENVIRONMENTS_NOTE = "A compiled loop over steps; nothing leaves it."

QUICK = {
    "renderer": Group(renderer, tables.renderer, RENDERER_NOTE),
    "environments": Group(few_environments, tables.environments, ENVIRONMENTS_NOTE),
    "adapters": Group(adapter, tables.interleaved("autoreset_mode", "adapter"), ADAPTERS_NOTE),
}
"""What takes two and a half minutes on two cores, in the order in which it is measured."""

FULL = {
    "renderer": Group(renderers, tables.renderer, RENDERER_NOTE),
    "adapters": Group(
        adapters, tables.interleaved("num_envs", "autoreset_mode", "adapter"), ADAPTERS_NOTE
    ),
    "distractors": Group(
        distractors,
        tables.interleaved("num_envs", "distractors"),
        "With a bank of 60 clips of 70 frames. Ratios are to the speed without: medians over "
        "rounds, in which all take a turn of 1 to 100 steps in one process, with bootstrap "
        "intervals of 95 %.",
    ),
    "environments": Group(environments, tables.environments, ENVIRONMENTS_NOTE),
}
"""What ``--full`` measures; it takes hours on a CPU."""

COMPILED = {
    "gpu-program": Group(
        gpu_programs,
        compiled.gpu,
        "Compiled, not run. Parts for the host are launched one after the other, a loop outside a "
        "graph among them as one; 1 is one CUDA graph. A loop of unknown length counts as one "
        "turn; outside a graph the host waits for it. Bytes count what every kernel reads and "
        "writes once. The model takes a kernel's bytes at the bandwidth of the card's data sheet, "
        "and 1.5 us at least: it compares forms of a program, and is no measurement.",
        measured=False,
    ),
    "tpu-program": Group(
        tpu_programs,
        compiled.tpu,
        "Compiled for a chip of a TPU v5e, not run. Bytes and times are the estimates of XLA.",
        measured=False,
    ),
}
"""What is compiled for accelerators that need not be here; half an hour for the first."""
