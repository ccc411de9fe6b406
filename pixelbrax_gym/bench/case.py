"""What is measured, as data."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

ABSENT = 3
"""Exit status of a process that lacks what it is to measure."""

Row = dict[str, Any]
"""A case's outcome as it is kept: ``group``, ``measure``, ``arguments``, ``status``, ``values``."""


class AbsentError(Exception):
    """What is to be measured is not here; the message says why."""


@dataclass(frozen=True)
class Case:
    """One measurement, made in a process of its own."""

    group: str
    """The part of the benchmark that it belongs to."""
    measure: str
    """``module.function`` of the package."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    package: str = "pixelbrax_gym.bench"

    @property
    def key(self) -> str:
        """Its name in the results."""
        arguments = json.dumps(dict(self.arguments), sort_keys=True)
        return f"{self.group} {self.measure} {arguments}"

    def command(self) -> list[str]:
        """Return the command that measures it, whose last line is the result, as JSON.

        Raises:
            AbsentError: it cannot run here.
        """
        function = f"{self.package}.{self.measure}"
        arguments = json.dumps(dict(self.arguments))
        return [sys.executable, "-m", "pixelbrax_gym.bench.worker", function, arguments]

    def environ(self) -> dict[str, str]:
        """Return variables that its process needs besides those of this one."""
        return {}


@dataclass(frozen=True)
class Group:
    """A part of the benchmark: its cases, their outcomes in Markdown, and what these show."""

    cases: Callable[[], Iterator[Case]]
    table: Callable[[list[Row]], str]
    note: str
