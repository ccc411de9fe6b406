"""Tables of tasks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeVar

Color = tuple[float, float, float]
"""Red, green, blue in [0, 1]."""


@dataclass(frozen=True, eq=False)
class Task:
    """One row of a suite's table.

    Attributes:
        name: name of the task.
        gymnasium_id: its id in Gymnasium.
        summary: the goal, and what ends an episode early.
        success_return: an episode with at least this return is a success; None for no such number.
        other_names: other libraries' names of the task, for the message about an unknown one.
    """

    name: str
    gymnasium_id: str
    summary: str
    success_return: float | None = field(default=None, kw_only=True)
    other_names: tuple[str, ...] = field(default=(), kw_only=True)


_Task = TypeVar("_Task", bound=Task)


def by_name(rows: Iterable[_Task]) -> Mapping[str, _Task]:
    """Return rows by task name."""
    return MappingProxyType({row.name: row for row in rows})
