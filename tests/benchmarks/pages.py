"""Tables and figures in pages, each between ``<!-- its name -->`` and ``<!-- end -->``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

MARKED = re.compile(r"(<!-- ([\w-]+) -->)(.*?)(<!-- end -->)", re.DOTALL)

Figures = Mapping[str, Callable[[], str]]


def filled(text: str, figures: Figures) -> str:
    """A page with what its figures are now.

    Raises:
        KeyError: a mark names no figure.
    """

    def fill(mark: re.Match[str]) -> str:
        figure = figures[mark[2]]()
        return f"{mark[1]}\n{figure}\n{mark[4]}" if "\n" in figure else mark[1] + figure + mark[4]

    return MARKED.sub(fill, text)


def names(text: str) -> set[str]:
    """The names of all marks of a page."""
    return {mark[1] for mark in MARKED.findall(text)}
