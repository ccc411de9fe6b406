"""Run ``pixelbrax COMMAND``: each module is a command, described by its docstring's first line."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, TypeVar

from pixelbrax_gym.bench.machine import installed_version
from pixelbrax_jax.cache import keep_programs
from pixelbrax_jax.validation import suggest

Options = TypeVar("Options")


_KEEP_NONE = "--keep-no-programs"


class CommandError(Exception):
    """An error that a command reports in one line, without a traceback."""


class UsageError(Exception):
    """Options that cannot be combined."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; ``arguments`` defaults to the arguments of this process.

    The exit status is 0 for success, 1 for an error, 2 for a wrong command line and 128 plus the
    signal's number after a signal to stop, as in shells: 130 for Ctrl-C.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    keeps_programs = given[:1] != [_KEEP_NONE]
    first, *rest = given[not keeps_programs :] or [""]
    if first in ("-h", "--help"):
        sys.stdout.write(_help())
        return 0
    if first == "--version":
        sys.stdout.write(f"{installed_version('pixelbrax') or 'not installed'}\n")
        return 0
    if first not in commands():
        unknown = f"unknown command {first!r}.{suggest(first, commands())}"
        sys.stderr.write(f"pixelbrax: {unknown if first else 'name a command.'}\n\n{_help()}")
        return 2
    _find_modules_here()
    try:
        with _warnings_of(first), _programs_kept() if keeps_programs else nullcontext():
            status: int = import_module(f"{__name__}.{first}").run(rest)
            return status
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except UsageError as error:
        say(first, error)
        return 2
    # Anything else is a defect, with a traceback.
    except (CommandError, ValueError, OSError, ImportError, MemoryError) as error:
        say(first, error)
        return 1
    finally:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            _flush(stream)


@contextmanager
def _programs_kept() -> Iterator[None]:
    """Cache compiled programs; say so when the folder is new."""
    try:
        folder = keep_programs()
    except FileNotFoundError:  # no home folder
        folder = None
    new = folder if folder and not folder.exists() else None
    yield
    if new and new.exists():
        with suppress(OSError, ValueError):
            sys.stderr.write(
                f"pixelbrax: the compiled programs are kept in {new}, so that the next start is "
                f"faster; 'pixelbrax {_KEEP_NONE} COMMAND' keeps none.\n"
            )


def say(command: str, message: object) -> None:
    """Write a line to stderr unless it is closed."""
    with suppress(OSError, ValueError):
        sys.stderr.write(f"pixelbrax {command}: {message}\n")


def commands() -> list[str]:
    """List the names of all commands."""
    return sorted(found.name for found in iter_modules(__path__) if not found.name.startswith("_"))


def parse(command: str, kind: type[Options], arguments: Sequence[str]) -> Options:
    """Parse arguments into the dataclass ``kind``, whose docstring and fields are the help."""
    import tyro

    return tyro.cli(kind, prog=f"pixelbrax {command}", args=arguments)


def _help() -> str:
    lines, width = [], max(map(len, commands())) + 2
    for name in commands():
        about = (import_module(f"{__name__}.{name}").__doc__ or "").partition("\n")[0]
        lines.append(f"  {name:{width}}{about}\n")
    return (
        f"usage: pixelbrax [{_KEEP_NONE}] COMMAND [options]\n\n"
        "Continuous control from pixels, on JAX.\n\n"
        f"commands:\n{''.join(lines)}\n"
        "'pixelbrax COMMAND --help' lists the options of one; 'pixelbrax --version' tells the "
        f"release. Compiled programs are kept for the next start, but not with {_KEEP_NONE}.\n"
    )


def _find_modules_here() -> None:
    """Append the current folder to ``sys.path``, last so that no file hides a library."""
    with suppress(OSError):  # the folder was deleted
        if not {"", (here := str(Path.cwd()))}.intersection(sys.path):
            sys.path.append(here)


@contextmanager
def _warnings_of(command: str) -> Iterator[None]:
    """Write each warning in one line, without its source."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        say(command, message)

    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.simplefilter("default", UserWarning)
        warnings.showwarning = show
        yield


def _flush(stream: Any) -> None:
    """Flush a stream; drop its text if that fails, because Python would then exit with 120."""
    try:
        stream.flush()
    except ValueError:  # It is closed.
        return
    except OSError:
        with Path(os.devnull).open("wb") as nowhere, suppress(OSError):
            os.dup2(nowhere.fileno(), stream.fileno())
