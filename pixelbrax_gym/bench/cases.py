"""What ``pixelbrax bench`` measures: in two and a half minutes, or in full."""

from __future__ import annotations

from collections.abc import Iterator

from pixelbrax_gym.bench import tables
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
    yield _scan("ant", 1, "pixels")
    yield _scan("ant", 100, "state")
    yield _scan("ant", 100, "pixels")


def environments() -> Iterator[Case]:
    """State only, pixels and the renderer alone, over the number of environments."""
    for task in TASKS:
        for num_envs in BATCHES:
            yield _scan(task, num_envs, "state")
            yield _scan(task, num_envs, "pixels")
            where = {"task": task, "num_envs": num_envs}
            yield Case("environments", "throughput.renderer", where)


def _scan(task: str, num_envs: int, obs_mode: str) -> Case:
    where = {"task": task, "num_envs": num_envs, "obs_mode": obs_mode}
    return Case("environments", "throughput.scan", where)


def adapter() -> Iterator[Case]:
    """Every adapter that is installed, of the task that compiles fastest.

    An adapter costs Python's time, whatever the task; nearly all of this case is compilation.
    """
    where = {"task": "inverted_pendulum", "num_envs": 100, "seconds": 6.0}
    yield Case("adapters", "adapters.compare", where)


def adapters() -> Iterator[Case]:
    """Every adapter that is installed."""
    for task, num_envs in (("ant", 256), ("ant", 1), *((task, 1000) for task in TASKS)):
        yield Case("adapters", "adapters.compare", {"task": task, "num_envs": num_envs})


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
    "environments": Group(environments, tables.environments, ENVIRONMENTS_NOTE),
}
"""What ``--full`` measures; it takes hours on a CPU."""
