"""What a benchmark is made of: cases, each measured in a process of its own, in groups."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

TASKS = ("halfcheetah", "walker2d", "ant", "humanoid")

Row = dict[str, Any]
"""Stored outcome of a case: ``group``, ``measure``, ``arguments``, ``status``, ``values``, ..."""

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
        return [sys.executable, "-m", "tests.benchmarks.runner", function, arguments]

    def environ(self) -> dict[str, str]:
        """Return additional environment variables for the process."""
        return {}


@dataclass(frozen=True)
class Group:
    """A part of the benchmark: its cases, a function for their table in Markdown, and a note."""

    cases: Sequence[Case]
    table: Callable[[list[Row]], str]
    note: str
