"""Messages and a progress bar; their errors do not stop a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

Report = Callable[[str], object]
"""Receives messages about the run; it may raise."""


def silent(line: str) -> None:
    """Ignore a message."""
    del line


def reason(error: BaseException) -> str:
    """Describe an error in one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


class Messages:
    """Forwards messages; ``failure`` is the first error of the receiver, or empty."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self.failure = ""

    def __call__(self, line: str) -> None:
        """Forward a message or store the error."""
        try:
            self._report(line)
        except Exception as error:
            self.failure = self.failure or reason(error)


class Bar(tqdm):
    """An optional progress bar, gone after an error; ``failure`` is the error, or empty."""

    def __init__(self, shown: bool, total: int, report: Report) -> None:
        self.failure, self._report = "", report
        with self._watched():
            super().__init__(total=total, unit="iteration", disable=not shown)

    def display(self, *arguments: Any, **options: Any) -> None:
        """Draw the bar."""
        with self._watched():
            super().display(*arguments, **options)

    def close(self) -> None:
        """Draw the bar for the last time."""
        with self._watched():
            super().close()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.disable = True
            if not self.failure:
                self.failure = why = reason(error)
                self._report(
                    f"the progress bar cannot be drawn: {why}; the run continues without it"
                )
