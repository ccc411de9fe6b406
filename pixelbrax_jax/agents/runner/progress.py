"""What a person sees of a run, lines and a progress bar; either may fail at any time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from tqdm import tqdm

Report = Callable[[str], object]
"""Gets lines about what is going on; it may raise."""


def silent(line: str) -> None:
    """Drop a line."""
    del line


def reason(error: BaseException) -> str:
    """Return why something failed, in one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(text).splitlines()[0]


class Messages:
    """Passes lines on; ``failure`` tells why one could not be written, and is empty otherwise."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self.failure = ""

    def __call__(self, line: str) -> None:
        """Pass a line on, or record why that fails."""
        try:
            self._report(line)
        except Exception as error:
            self.failure = self.failure or reason(error)


class Bar:
    """tqdm's progress bar, or nothing; ``failure`` as of `Messages`."""

    def __init__(self, shown: bool, total: int, report: Report) -> None:
        """Draw the bar of ``total`` iterations; ``report`` gets a line if that fails."""
        self._report = report
        self.failure = ""
        self._bar = tqdm(disable=True)
        with self._watched():
            self._bar = tqdm(total=total, unit="iteration", disable=not shown)

    def update(self, number: int, record: dict[str, float] | None = None) -> None:
        """Add iterations, and show the return of a record if it has one."""
        with self._watched():
            self._bar.update(number)
            if record and "episode/return" in record:
                self._bar.set_postfix(episode_return=f"{record['episode/return']:.1f}")

    def close(self) -> None:
        """Draw the bar a last time."""
        with self._watched():
            self._bar.close()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Give the bar up if it cannot be drawn."""
        try:
            yield
        except Exception as error:
            bar, self._bar = self._bar, tqdm(disable=True)
            # Left open, it would be drawn again beneath every line.
            with suppress(Exception):
                bar.close()
            self.failure = reason(error)
            self._report(
                f"the progress bar cannot be drawn: {self.failure}; the run goes on without it"
            )
