"""List the cases of ``pixelbrax bench``, quick and full."""

from __future__ import annotations

from collections.abc import Iterator

from pixelbrax_gym.bench import tables
from pixelbrax_gym.bench.case import Case, Group

TASKS = ("halfcheetah", "walker2d", "ant", "humanoid")
BATCHES = (1, 10, 100, 1000, 4096, 8192)


def renderer() -> Iterator[Case]:
    """Yield the renderer with default options."""
    yield Case("renderer", "throughput.renderer", {"task": "ant", "num_envs": 256})


def renderers() -> Iterator[Case]:
    """Yield the renderer with several looks, image sizes and renderers."""
    yield from renderer()
    for options in (
        {"look": "original"},
        {"shadows": True},
        {"size": 64},
        {"renderer": "reference", "num_envs": 8},
    ):
        yield Case("renderer", "throughput.renderer", {"task": "ant", "num_envs": 256, **options})


def few_environments() -> Iterator[Case]:
    """Yield Ant with one and a hundred environments."""
    yield _scan("ant", 1, "pixels")
    yield _scan("ant", 100, "state")
    yield _scan("ant", 100, "pixels")


def environments() -> Iterator[Case]:
    """Yield state only, pixels and the renderer for several numbers of environments."""
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
    """Yield one comparison of all adapters, with the task that compiles fastest."""
    where = {"task": "inverted_pendulum", "num_envs": 100, "seconds": 6.0}
    yield Case("adapters", "adapters.compare", where)


def adapters() -> Iterator[Case]:
    """Yield comparisons of all adapters."""
    for task, num_envs in (("ant", 256), ("ant", 1), *((task, 1000) for task in TASKS)):
        yield Case("adapters", "adapters.compare", {"task": task, "num_envs": num_envs})


RENDERER_NOTE = "From link poses to packed pixels, without physics."
ADAPTERS_NOTE = (
    "The ratio is relative to the JAX loop with the same autoreset mode, which waits for each "
    "step. It is a median over rounds with a 95 % bootstrap interval. In each round every adapter "
    "runs 8 to 100 steps in the same process."
)
ENVIRONMENTS_NOTE = "A compiled loop over steps that returns no observations."

QUICK = {
    "renderer": Group(renderer, tables.renderer, RENDERER_NOTE),
    "environments": Group(few_environments, tables.environments, ENVIRONMENTS_NOTE),
    "adapters": Group(adapter, tables.interleaved("autoreset_mode", "adapter"), ADAPTERS_NOTE),
}
"""Groups by default, in the order of measurement; they take two and a half minutes on two cores."""

FULL = {
    "renderer": Group(renderers, tables.renderer, RENDERER_NOTE),
    "adapters": Group(
        adapters, tables.interleaved("num_envs", "autoreset_mode", "adapter"), ADAPTERS_NOTE
    ),
    "environments": Group(environments, tables.environments, ENVIRONMENTS_NOTE),
}
"""Groups of ``--full``; they take hours on a CPU."""
