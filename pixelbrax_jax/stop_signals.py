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
ends a hanging process and no scheduler sends it; SIGTSTP because a process may continue."""

_APART = 1.0
"""Seconds between two intended SIGINTs; a wrapper may pass one key press on twice."""


class StopRequest:
    """Records the number of the first ``signal`` that asks the process to stop; 0 before it.

    A second Ctrl-C raises ``KeyboardInterrupt``; other signals never do, because closing terminals
    and schedulers send several of them for one request.
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
            name = signal.Signals(number).name
            self._report(
                f"{name}: stopping within two iterations, with a checkpoint; a second Ctrl-C stops "
                "at once, without one"
            )


@contextmanager
def stop_requests(report: Callable[[str], object]) -> Iterator[StopRequest]:
    """Record requests to stop until the end of the block; ``report`` gets a line at the first."""
    request = StopRequest(report)
    with handling(request.ask):
        yield request


@contextmanager
def handling(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Handle the signals that ask a long command to stop, until the end of the block.

    Signals other than SIGINT and SIGTERM are left out if they are ignored (``nohup``) or if the
    program has its own handler (launchers that requeue a job). Outside the main thread, where
    Python allows no handlers, nothing is handled.
    """
    before = {}
    for name in (*_ALWAYS, *_UNLESS_IN_USE):
        number = getattr(signal, name, None)  # Windows has not all of them.
        if number and (name in _ALWAYS or signal.getsignal(number) == signal.SIG_DFL):
            with suppress(ValueError):
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            # None means that the handler was not installed from Python.
            signal.signal(number, signal.SIG_DFL if old is None else old)
