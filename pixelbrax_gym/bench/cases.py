"""Define a benchmark as data: the cases of ``pixelbrax bench``, quick and full."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pixelbrax_gym.bench import tables
from pixelbrax_gym.bench.tables import Row

TASKS = ("halfcheetah", "walker2d", "ant", "humanoid")
BATCHES = (1, 10, 100, 1000, 4096, 8192)

ABSENT = 3
"""Exit status of a process in which something to be measured is not installed."""


class AbsentError(Exception):
    """Something to be measured is not available here, for the reason in the message."""


@dataclass(frozen=True)
class Case:
    """One measurement, which runs in a separate process."""

    group: str
    """Name of its group."""
    measure: str
    """``module.function`` of the package."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    package: str = "pixelbrax_gym.bench"

    @property
    def key(self) -> str:
        """Key of the case in the results."""
        arguments = json.dumps(dict(self.arguments), sort_keys=True)
        return f"{self.group} {self.measure} {arguments}"

    def command(self) -> list[str]:
        """Return the command to run; the last line of its output is the result as JSON.

        Raises:
            AbsentError: the case cannot run here.
        """
        function = f"{self.package}.{self.measure}"
        arguments = json.dumps(dict(self.arguments))
        return [sys.executable, "-m", "pixelbrax_gym.bench.runner", function, arguments]

    def environ(self) -> dict[str, str]:
        """Return additional environment variables for the process."""
        return {}


@dataclass(frozen=True)
class Group:
    """A part of the benchmark: its cases, a function for their table in Markdown, and a note."""

    cases: Sequence[Case]
    table: Callable[[list[Row]], str]
    note: str


def _renderer(**options: Any) -> Case:
    where = {"task": "ant", "num_envs": 256, **options}
    return Case("renderer", "throughput.renderer", where)


def _scan(task: str, num_envs: int, obs_mode: str) -> Case:
    where = {"task": task, "num_envs": num_envs, "obs_mode": obs_mode}
    return Case("environments", "throughput.scan", where)


def _all_of(task: str, num_envs: int) -> list[Case]:
    drawn = {"task": task, "num_envs": num_envs}
    return [
        _scan(task, num_envs, "state"),
        _scan(task, num_envs, "pixels"),
        Case("environments", "throughput.renderer", drawn),
    ]


def _adapters(task: str, num_envs: int, **options: Any) -> Case:
    where = {"task": task, "num_envs": num_envs, **options}
    return Case("adapters", "adapters.compare", where)


_RENDERER_NOTE = "From link poses to packed pixels, without physics."
_ADAPTERS_NOTE = (
    "The ratio is relative to the JAX loop with the same autoreset mode, which waits for each "
    "step. It is a median over rounds with a 95 % bootstrap interval. In each round every adapter "
    "runs 8 to 100 steps in the same process."
)
_ENVIRONMENTS_NOTE = "A compiled loop over steps that returns no observations."

QUICK = {
    "renderer": Group([_renderer()], tables.renderer, _RENDERER_NOTE),
    "environments": Group(
        [_scan("ant", 1, "pixels"), _scan("ant", 100, "state"), _scan("ant", 100, "pixels")],
        tables.environments,
        _ENVIRONMENTS_NOTE,
    ),
    # The task that compiles fastest.
    "adapters": Group(
        [_adapters("inverted_pendulum", 100, seconds=6.0)],
        tables.interleaved("autoreset_mode", "adapter"),
        _ADAPTERS_NOTE,
    ),
}
"""Groups by default, in the order of measurement; they take two and a half minutes on two cores."""

FULL = {
    "renderer": Group(
        [
            _renderer(),
            _renderer(look="original"),
            _renderer(shadows=True),
            _renderer(size=64),
            _renderer(renderer="reference", num_envs=8),
        ],
        tables.renderer,
        _RENDERER_NOTE,
    ),
    "adapters": Group(
        [_adapters("ant", 256), _adapters("ant", 1), *(_adapters(task, 1000) for task in TASKS)],
        tables.interleaved("num_envs", "autoreset_mode", "adapter"),
        _ADAPTERS_NOTE,
    ),
    "environments": Group(
        [case for task in TASKS for num_envs in BATCHES for case in _all_of(task, num_envs)],
        tables.environments,
        _ENVIRONMENTS_NOTE,
    ),
}
"""Groups of ``--full``; they take hours on a CPU."""
