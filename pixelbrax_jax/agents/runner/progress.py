"""What a person sees of a run, lines and a progress bar; either may fail at any time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any


def reason(error: BaseException) -> str:
    """Return why something failed, in one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


class Messages:
    """Passes lines on for as long as that is possible.

    Attributes:
        failure: why a line could not be written; empty if all were.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self.failure = ""

    def __call__(self, line: str) -> None:
        """Pass a line on, or record why that fails."""
        try:
            self._report(line)
        except Exception as error:
            self.failure = self.failure or reason(error)


class Bar:
    """tqdm's progress bar, or nothing.

    Attributes:
        failure: why the bar could not be drawn; empty if it could.
    """

    def __init__(self, shown: bool, total: int, report: Callable[[str], None]) -> None:
        """Draw the bar.

        Args:
            shown: whether there is one.
            total: number of iterations.
            report: gets a line if the bar fails.
        """
        self._bar: Any = None
        self._report = report
        self.failure = ""
        if shown:
            from tqdm import tqdm

            try:
                self._bar = tqdm(total=total, unit="iteration")
            except Exception as error:
                self._fail(error)

    def update(self, number: int, record: dict[str, float] | None = None) -> None:
        """Add iterations, and show the return of a record if it has one.

        Args:
            number: of iterations.
            record: metrics by name.
        """
        if self._bar is None:
            return
        try:
            self._bar.update(number)
            if record and "episode/return" in record:
                self._bar.set_postfix(episode_return=f"{record['episode/return']:.1f}")
        except Exception as error:
            self._fail(error)

    def close(self) -> None:
        """Draw the bar a last time."""
        if self._bar is None:
            return
        try:
            self._bar.close()
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        bar, self._bar = self._bar, None
        # Left open, it would be drawn again beneath every line.
        with suppress(Exception):
            bar.close()
        self.failure = reason(error)
        self._report(
            f"the progress bar cannot be drawn: {self.failure}; the run goes on without it"
        )
