"""Tables in pages of the documentation, each between ``<!-- its name -->`` and ``<!-- end -->``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path


def redraw(page: Path, tables: Mapping[str, str]) -> None:
    """Replace what stands between the marks."""
    text = page.read_text("utf-8")
    for name, table in tables.items():
        text = _between(name).sub(lambda found, table=table: found[1] + table + found[3], text)
    page.write_text(text, "utf-8")


def drawn(page: Path, name: str) -> str:
    """What stands between the marks now.

    Raises:
        ValueError: there are no such marks.
    """
    found = _between(name).search(page.read_text("utf-8"))
    if found is None:
        raise ValueError(f"{page} has no table {name!r}")
    return found[2]


def without_tables(text: str) -> str:
    """A page's text without what is drawn into it."""
    return re.sub(r"<!-- [\w-]+ -->\n.*?<!-- end -->", "", text, flags=re.DOTALL)


def _between(name: str) -> re.Pattern[str]:
    return re.compile(f"(<!-- {name} -->\n)(.*?)(<!-- end -->)", re.DOTALL)
