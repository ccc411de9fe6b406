"""Requests to stop: Ctrl-C, the signals of schedulers, the SIGHUP of a closed terminal."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pixelbrax_jax.stop_signals import signal_name, stop_signals

_APART = 1.0
"""Seconds between two SIGINTs that a person means; a wrapper may pass one key press on twice."""


class StopRequest:
    """Records the signal by which somebody asks the process to stop.

    The first signal is only recorded. A second Ctrl-C stops at once, by ``KeyboardInterrupt``. No
    other signal does: a closing terminal and a scheduler send several of them for one request.

    Attributes:
        signal: number of the first signal; 0 as long as there was none.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.signal = 0
        self._report = report
        self._first_interrupt: float | None = None

    def ask(self, number: int, frame: Any) -> None:
        """Handle a signal.

        Raises:
            KeyboardInterrupt: it is a second SIGINT.
        """
        del frame
        if number == signal.SIGINT:
            now = time.monotonic()
            if self._first_interrupt is None:
                self._first_interrupt = now
            elif now - self._first_interrupt > _APART:
                raise KeyboardInterrupt
        if self.signal:
            return
        self.signal = number
        # The terminal may be gone, and another line may be half written.
        with suppress(Exception):
            self._report(
                f"{signal_name(number)}: stopping within two iterations, with a checkpoint; a "
                "second Ctrl-C stops at once, without one"
            )


@contextmanager
def stop_requests(report: Callable[[str], None]) -> Iterator[StopRequest]:
    """Handle the signals that ask a process to stop, until the end of the block.

    Outside the main thread, where Python allows no handlers, the request stays empty. Which signals
    there are, ``stop_signals`` says.

    Args:
        report: gets a line when the first signal comes; it may raise.
    """
    request = StopRequest(report)
    before = {}
    for number in stop_signals():
        with suppress(ValueError):
            before[number] = signal.signal(number, request.ask)
    try:
        yield request
    finally:
        for number, handler in before.items():
            # None is a handler that was not installed from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
