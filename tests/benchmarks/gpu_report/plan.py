"""What a report measures, the most wanted first."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pixelbrax_jax.tasks import TASKS
from tests.benchmarks.case import Case

HERE = "tests.benchmarks.gpu_report"

HOST_LOOPS = "--xla_gpu_enable_command_buffer=-WHILE"
"""XLA then launches a loop's body from the host, in place of one CUDA graph."""


@dataclass(frozen=True)
class Timed(Case):
    """A case that compiles beside others, and is timed alone."""

    package: str = HERE
    seconds: float = 30.0
    """Longest time after compilation."""
    least: float = 6.0
    """With less time than this left it is not begun."""
    gigabytes: float = 0.0
    """A rough upper bound of its memory on the device."""

    def command(self) -> list[str]:
        """Return the command of its process."""
        arguments = json.dumps(dict(self.arguments))
        return [sys.executable, "-W", "ignore", "-m", f"{HERE}.worker", self.measure, arguments]


@dataclass(frozen=True)
class Extent:
    """How much is measured; ``run`` is algorithm, preset, task and arguments of a training run."""

    tasks: tuple[str, ...]
    headline: tuple[str, ...]
    checked: tuple[str, ...]
    sizes: tuple[int, ...]
    batches: tuple[int, ...]
    check_size: int
    runs: tuple[tuple[str, str, str, tuple[str, ...]], ...]
    learning_seconds: float
    tests: tuple[str, ...]
    tests_seconds: float
    adapters: tuple[str, int, float]
    peers: tuple[tuple[str, int, int], ...]
    by_warp: tuple[str, ...]


CARD = Extent(
    tasks=("halfcheetah", "ant", "dmc_cartpole_swingup", "humanoid", "dmc_cheetah_run",
           "dmc_walker_walk"),
    headline=("halfcheetah", "ant", "dmc_cartpole_swingup"),
    checked=tuple(TASKS),
    sizes=(84, 64),
    batches=(8192, 1024, 64, 1),
    check_size=84,
    runs=(
        ("ppo", "cpu", "halfcheetah", ()),
        ("drqv2", "fast", "dmc_walker_walk", ()),
    ),
    learning_seconds=150.0,
    tests=(),
    tests_seconds=240.0,
    adapters=("halfcheetah", 1024, 30.0),
    peers=(("ant", 1024, 84), ("humanoid", 1024, 64), ("ant", 8192, 64)),
    by_warp=("dmc_cartpole_swingup", "dmc_walker_walk", "dmc_cheetah_run", "dmc_humanoid_walk"),
)  # fmt: skip

REHEARSAL = Extent(
    tasks=("inverted_pendulum", "dmc_cartpole_swingup"),
    headline=("inverted_pendulum",),
    checked=("inverted_pendulum", "dmc_cartpole_swingup", "reacher"),
    sizes=(48, 36),
    batches=(4, 1),
    check_size=24,
    runs=(("ppo", "ci", "inverted_pendulum", ("--num-envs", "32")),),
    learning_seconds=120.0,
    tests=("tests/gpu/test_sharing.py", "-k", "buffer or action_is"),
    tests_seconds=150.0,
    adapters=("inverted_pendulum", 4, 2.0),
    peers=(("inverted_pendulum", 4, 24),),
    by_warp=("dmc_cartpole_swingup",),
)


def plan(extent: Extent, kernel: bool = True) -> list[Timed]:
    """Return the cases in the order in which they are measured.

    Without the ``kernel`` its checks and its speed are left out.
    """
    cases: dict[str, Timed] = {}
    for case in _ordered(extent):
        if kernel or not _needs_kernel(case):
            cases.setdefault(case.key, case)
    return list(cases.values())


def _needs_kernel(case: Case) -> bool:
    return case.group == "kernel" or case.arguments.get("renderer") == "pallas"


def _ordered(extent: Extent) -> Iterator[Timed]:
    def check(task: str) -> Timed:
        where = {"task": task, "size": extent.check_size}
        return Timed("kernel", "checks.kernel", where, gigabytes=0.5)

    # Checks of the tasks that are timed come first; all others take minutes, and come later.
    yield from map(check, extent.tasks)
    few = extent.batches[:2]
    yield from (
        steps(task, n, size) for task in extent.headline for n in few for size in extent.sizes
    )
    yield from (steps(task, n, None) for task in extent.headline for n in few)
    task, num_envs, seconds = extent.adapters
    sharing = {"task": task, "num_envs": num_envs, "seconds": seconds}
    yield Timed("adapters", "sharing.compare", sharing, seconds=60 + 3 * seconds, gigabytes=3.0)
    yield from map(check, extent.checked)
    for algorithm, preset, task, options in extent.runs:
        names = {"algorithm": algorithm, "preset": preset, "task": task, "options": options}
        yield Timed(
            "learning", "programs.learning", names,
            seconds=extent.learning_seconds, least=0.4 * extent.learning_seconds, gigabytes=4.0,
        )  # fmt: skip
    yield Timed(
        "tests", "programs.tests", {"arguments": extent.tests},
        seconds=extent.tests_seconds, least=0.5 * extent.tests_seconds, gigabytes=4.0,
    )  # fmt: skip
    # A handful of cases, before a grid that may take what is left.
    for task, num_envs, size in extent.peers:
        where = {"task": task, "num_envs": num_envs, "size": size}
        memory = _gigabytes(num_envs, size)
        for name in ("pallas", "fused"):
            drawn = where | {"renderer": name}
            yield Timed("renderers", "speeds.frames", drawn, gigabytes=4 * memory)
        yield Timed("renderers", "renderers.mjx", where, gigabytes=memory)
        yield Timed("renderers", "renderers.warp", where, seconds=60, gigabytes=memory)
    for task in extent.by_warp:
        yield from (steps(task, n, None, engine="warp") for n in few)
    # By policy and batch, so that a cut grid has a figure of every task.
    for policy in ("random", "network"):
        for n in extent.batches:
            for size in (*extent.sizes, None):
                yield from (steps(task, n, size, policy) for task in extent.tasks)
    for task in extent.headline:
        yield steps(task, few[-1], extent.sizes[0], flags=HOST_LOOPS)


def steps(
    task: str,
    num_envs: int,
    size: int | None,
    policy: str = "random",
    flags: str = "",
    engine: str = "auto",
) -> Timed:
    """Return the case of steps per second with images of a size, or of states without one."""
    where: Mapping[str, Any] = {
        "task": task,
        "num_envs": num_envs,
        "size": size,
        "policy": policy,
        "flags": flags,
        "engine": engine,
    }
    return Timed("speeds", "speeds.steps", where, gigabytes=_gigabytes(num_envs, size or 0))


def _gigabytes(num_envs: int, size: int) -> float:
    """Return the memory of three copies of stacked frames, packed images, and the process."""
    return 1.0 + num_envs * (size * size * (3 * 9 + 2 * 4) + 2e4) / 1e9
