"""The signals by which people, schedulers and systems ask a process to stop."""

from __future__ import annotations

import signal

_ALWAYS = ("SIGINT", "SIGTERM")
"""Ctrl-C; and what ``kill``, systemd, Kubernetes, HTCondor and most schedulers send first."""

_UNLESS_IN_USE = ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
"""A closed terminal; the warnings of Slurm (``--signal``), LSF (``-wa``; SIGUSR2 at a run limit)
and Grid Engine (``-notify``, soft limits); and those of the kernel, LSF and Grid Engine at a limit
of processor time. SIGQUIT is not among them: no scheduler sends it by itself, and a person ends a
process that hangs with it. Neither is SIGTSTP, after which a process may be continued."""


def stop_signals() -> list[signal.Signals]:
    """Return the signals that a long command shall take for a request to stop.

    Those besides SIGINT and SIGTERM are left alone where they are ignored, as ``nohup`` has it, and
    where the program has a handler of its own, as launchers that requeue a job have one.
    """
    # Windows has not all of them.
    numbers = {name: getattr(signal, name, None) for name in (*_ALWAYS, *_UNLESS_IN_USE)}
    return [
        number
        for name, number in numbers.items()
        if number is not None and (name in _ALWAYS or signal.getsignal(number) == signal.SIG_DFL)
    ]


def signal_name(number: int) -> str:
    """Return what a signal is called, as SIGTERM."""
    return signal.Signals(number).name
