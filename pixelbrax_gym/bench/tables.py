"""Format tables in Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any


def table(heads: Iterable[str], lines: Iterable[Iterable[Any]]) -> str:
    """Return a Markdown table with padded columns."""
    rows = [[str(cell) for cell in row] for row in (list(heads), *lines)]
    widths = [max(3, *map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    padded = (map(str.ljust, row, widths) for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)


def number(value: float | None) -> str:
    """Format with three significant digits and thousands separators; a hyphen if unknown."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(0, digits)}f}"


COMPARED = ("steps/s", "ratio", "interval", "rounds")
"""Heads of ``compared``."""


def compared(values: Mapping[str, Any]) -> list[str]:
    """Format a result of ``adapters.compare_speeds``."""
    return [
        number(values["steps_per_second"]),
        f"{values['ratio']:.2f}",
        " to ".join(f"{bound:.2f}" for bound in values["interval"]),
        str(values["runs"]),
    ]
