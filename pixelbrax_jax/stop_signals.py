"""Requests to stop: Ctrl-C, signals of schedulers, SIGHUP of a closed terminal."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

_ALWAYS = ("SIGINT", "SIGTERM")
"""Ctrl-C, and the first signal of ``kill``, systemd, Kubernetes, HTCondor and most schedulers."""

_UNLESS_IN_USE = ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
"""A closed terminal; warnings of Slurm (``--signal``), LSF (``-wa``; SIGUSR2 at a run limit) and
Grid Engine (``-notify``, soft limits); and limits of processor time. SIGQUIT is missing because it
ends a hanging process and no scheduler sends it; SIGTSTP because a process may continue after
it."""

_APART = 1.0
"""Seconds between two intended SIGINTs; a wrapper may pass one key press on twice."""


def stop_signals() -> list[signal.Signals]:
    """Return the signals that a long command handles as a request to stop.

    Signals other than SIGINT and SIGTERM are left out if they are ignored (``nohup``) or if the
    program has its own handler (launchers that requeue a job).
    """
    # Windows has not all of them.
    numbers = {name: getattr(signal, name, None) for name in (*_ALWAYS, *_UNLESS_IN_USE)}
    return [
        number
        for name, number in numbers.items()
        if number is not None and (name in _ALWAYS or signal.getsignal(number) == signal.SIG_DFL)
    ]


def signal_name(number: int) -> str:
    """Return the name of a signal, such as SIGTERM."""
    return signal.Signals(number).name


class StopRequest:
    """Records the signal that asks the process to stop.

    The first signal is only recorded. A second Ctrl-C raises ``KeyboardInterrupt``; other signals
    never do, because closing terminals and schedulers send several of them for one request.

    Attributes:
        signal: number of the first signal; 0 before there is one.
    """

    def __init__(self, report: Callable[[str], object]) -> None:
        self.signal = 0
        self._report = report
        self._first_interrupt: float | None = None

    def ask(self, number: int, frame: Any) -> None:
        """Handle a signal; raise KeyboardInterrupt for a second SIGINT."""
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
def stop_requests(report: Callable[[str], object]) -> Iterator[StopRequest]:
    """Handle the signals that ask a process to stop, until the end of the block.

    Outside the main thread, where Python allows no handlers, no request is recorded.

    Args:
        report: is called with one line at the first signal; it may raise.
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
            # None means that the handler was not installed from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
