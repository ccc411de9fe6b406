"""A case in a process of its own: ``python -m tests.benchmarks.gpu_report.worker MEASURE JSON``.

A measure compiles what it needs and returns a function; the process then writes ``READY`` and the
seconds that took. A line with a number of seconds on its standard input has it call the function,
and write the result as a line of JSON. It ends with the process that started it.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import queue
import signal
import sys
import threading
import time
from contextlib import suppress

from tests.benchmarks.case import ABSENT, AbsentError
from tests.benchmarks.runner import peak_bytes

READY, RESULT = "READY ", "RESULT "


def main() -> None:
    """Prepare, wait to be told, measure."""
    started = time.perf_counter()
    requests: queue.Queue[float] = queue.Queue()
    _wake_when_alone()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    module, _, name = sys.argv[1].rpartition(".")
    try:
        measure = getattr(importlib.import_module(f"{__package__}.{module}"), name)
        timed = measure(**json.loads(sys.argv[2]))
        _say(READY + str(round(time.perf_counter() - started, 1)))
        values = timed(requests.get())
    except (AbsentError, ImportError) as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        sys.exit(ABSENT)
    found = {"values": values, "peak_bytes": peak_bytes() if "jax" in sys.modules else None}
    _say(RESULT + json.dumps(found))


def _say(line: str) -> None:
    sys.stdout.write(f"\n{line}\n")
    sys.stdout.flush()


def _listen(requests: queue.Queue[float]) -> None:
    """Pass on requests; at the end of the input the process that sent them has ended."""
    # sys.stdin would be locked by this thread when Python ends.
    with open(0, "rb", buffering=0, closefd=False) as lines:
        for line in lines:
            requests.put(float(line))
    os.killpg(0, signal.SIGKILL)


def _wake_when_alone() -> None:
    """Have Linux continue this process, which may be paused, when its parent ends."""
    set_signal_of_parents_end = 1
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(set_signal_of_parents_end, int(signal.SIGCONT))


if __name__ == "__main__":
    main()
