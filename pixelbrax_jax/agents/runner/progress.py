"""Messages and a progress bar; their errors do not stop a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

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


class Bar:
    """An optional tqdm progress bar; ``failure`` is its error, or empty."""

    def __init__(self, shown: bool, total: int, report: Report) -> None:
        """Show a bar of ``total`` iterations."""
        self._report = report
        self.failure = ""
        self._bar = tqdm(disable=True)
        with self._watched():
            self._bar = tqdm(total=total, unit="iteration", disable=not shown)

    def update(self, number: int, record: dict[str, float] | None = None) -> None:
        """Add iterations, and show the return in a record."""
        with self._watched():
            self._bar.update(number)
            if record and "episode/return" in record:
                self._bar.set_postfix(episode_return=f"{record['episode/return']:.1f}")

    def close(self) -> None:
        """Draw the bar for the last time."""
        with self._watched():
            self._bar.close()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Remove the bar after an error."""
        try:
            yield
        except Exception as error:
            # An open bar would be redrawn after every message.
            with suppress(Exception):
                self._bar.close()
            self.failure = reason(error)
            self._report(
                f"the progress bar cannot be drawn: {self.failure}; the run continues without it"
            )
