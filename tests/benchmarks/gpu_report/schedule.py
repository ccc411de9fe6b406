"""Compile many cases at once, time one after the other with nothing beside it, end in time."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from tests.benchmarks.case import AbsentError
from tests.benchmarks.gpu_report.plan import Timed
from tests.benchmarks.gpu_report.worker import READY, RESULT
from tests.benchmarks.runner import outcome_of

PATIENCE = 300.0
"""Seconds that the others wait for a case that compiles."""

LAST = 30.0
"""Seconds before the end in which whatever is compiled is timed, in any order."""

GRACE = 5.0
"""Seconds that a case may take beyond its time."""

Record = Callable[[Timed, dict[str, Any]], object]


class Process:
    """A case in a process of its own, which compiles and then waits to be told to go.

    Attributes:
        ready: set when it waits, or has ended.
        prepared_seconds: how long it took until then; None if it failed before.
        paused_seconds: how long it was paused meanwhile.
    """

    def __init__(self, case: Timed, environ: Mapping[str, str]) -> None:
        self.case = case
        self.ready = threading.Event()
        self.prepared_seconds: float | None = None
        self.paused_seconds = 0.0
        self._result = ""
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115
        flags = f"{environ.get('XLA_FLAGS', '')} {case.arguments.get('flags', '')}".strip()
        self._process = subprocess.Popen(
            case.command(),
            env={**environ, **({"XLA_FLAGS": flags} if flags else {})},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(READY):
                self.prepared_seconds = float(line.removeprefix(READY))
                self.ready.set()
            elif line.startswith(RESULT):
                self._result = line.removeprefix(RESULT)
        self.ready.set()

    def time(self, seconds: float) -> dict[str, Any] | None:
        """Have a case that is ready measure; return its outcome, or None if it takes longer."""
        assert self._process.stdin is not None
        started = time.monotonic()
        with suppress(OSError):  # it has ended, and its status says why
            self._process.stdin.write(f"{seconds}\n")
            self._process.stdin.flush()
        try:
            self._process.wait(seconds + GRACE)
        except subprocess.TimeoutExpired:
            return None
        self._reader.join(GRACE)
        self._errors.seek(0)
        found = outcome_of(self._process.returncode, self._result, self._errors.read())
        prepared = self.prepared_seconds
        return found | {
            "prepared_seconds": None if prepared is None else prepared - self.paused_seconds,
            "seconds": round(time.monotonic() - started, 1),
        }

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the process and those that it has started."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, number)

    def end(self) -> None:
        """End it, if it has not ended."""
        self.signal(signal.SIGKILL)
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            with suppress(OSError):
                stream.close()  # type: ignore[union-attr]


def run(
    cases: Sequence[Timed],
    record: Record,
    seconds: float,
    parallel: int,
    environ: Mapping[str, str],
    patience: float = PATIENCE,
) -> None:
    """Measure the cases in their order for so many seconds; ``record`` gets each outcome at once.

    At most ``parallel`` cases compile at a time, and as many wait. Whoever compiles is paused while
    one is timed.
    """
    end, todo, pool = time.monotonic() + seconds, deque(cases), deque[Process]()

    def fill() -> None:
        while todo and len(pool) < 2 * parallel:
            if sum(not process.ready.is_set() for process in pool) >= parallel:
                return
            case = todo.popleft()
            if case.least <= end - time.monotonic():
                try:
                    pool.append(Process(case, environ))
                except (AbsentError, OSError) as error:
                    record(case, {"status": "absent", "why": str(error), "seconds": 0.0})

    try:
        fill()
        while pool:
            head = _await_head(pool, fill, end, patience)
            if head is None:
                return
            pool.remove(head)
            try:
                left = end - time.monotonic()
                if not head.ready.is_set():
                    why = f"it compiled for longer than {patience:.0f} s"
                    record(head.case, {"status": "failed", "why": why, "seconds": patience})
                elif left >= head.case.least or head.prepared_seconds is None:
                    paused = [process for process in pool if not process.ready.is_set()]
                    limit = min(head.case.seconds, left)
                    with _pause(paused):
                        outcome = head.time(limit)
                    if outcome is not None:
                        record(head.case, outcome)
                    elif limit == head.case.seconds:
                        why = f"it took longer than {limit:.0f} s"
                        record(head.case, {"status": "failed", "why": why, "seconds": limit})
            finally:
                head.end()
            fill()
    finally:
        for process in pool:
            process.end()


def _await_head(
    pool: deque[Process], fill: Callable[[], None], end: float, patience: float
) -> Process | None:
    """Return the first process when it is ready, or impatience ended; None when time is over."""
    head, since = pool[0], time.monotonic()
    while not head.ready.wait(0.05):
        fill()
        now = time.monotonic()
        if now > end:
            return None
        if end - now < LAST:
            for other in pool:
                if other.ready.is_set() and other.case.least <= end - now:
                    return other
        if now - since > patience:
            return head
    return head


@contextmanager
def _pause(processes: Sequence[Process]) -> Iterator[None]:
    """Pause processes that compile."""
    began = time.monotonic()
    for process in processes:
        process.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        for process in processes:
            process.paused_seconds += time.monotonic() - began
            process.signal(signal.SIGCONT)
