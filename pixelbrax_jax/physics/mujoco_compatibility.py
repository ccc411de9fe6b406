"""What loading MuJoCo models and MuJoCo XLA says and does that nobody needs, for every engine."""

from __future__ import annotations

import contextlib
import io
import sys
import warnings
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import jax

from pixelbrax_jax.physics.opengl import mujoco

_KNOWN_WARNINGS: tuple[tuple[str, type[Warning]], ...] = (
    # Brax, at every load of a model.
    ("Brax System, piplines and environments are not actively", UserWarning),
    # Imported by Brax's generalized backend.
    ("JAXopt is no longer maintained", DeprecationWarning),
    # Brax reads MJX fields that moved; MJX still serves them.
    (r"Accessing `\w+` directly from `(Data|Model)` is deprecated", DeprecationWarning),
)
# Both suites' cheetahs say settotalmass; the mass it gives is still the one MuJoCo uses.
_KNOWN_MUJOCO_WARNING = "compiler attribute 'settotalmass' is deprecated"
# MJX prints a line when an optional dependency, Warp, is not installed.
_KNOWN_PRINT = "Failed to import "


@contextlib.contextmanager
def known_warnings_silenced() -> Iterator[None]:
    """Hide known warnings of Brax and its parts, and no others, while the block runs."""
    with warnings.catch_warnings():
        for message, category in _KNOWN_WARNINGS:
            warnings.filterwarnings("ignore", message=message, category=category)
        yield


@contextlib.contextmanager
def import_silenced() -> Iterator[None]:
    """Hide the known noise of importing Brax and MuJoCo XLA; print anything else afterwards."""
    printed = io.StringIO()
    with known_warnings_silenced(), contextlib.redirect_stdout(printed):
        yield
    for line in printed.getvalue().splitlines(keepends=True):
        if not line.startswith(_KNOWN_PRINT):
            sys.stdout.write(line)


@contextlib.contextmanager
def loading_silenced() -> Iterator[None]:
    """Hide the known noise of compiling a model; MuJoCo's other warnings become Python's.

    Without a handler MuJoCo appends its warnings to ``MUJOCO_LOG.TXT`` in the working
    directory. A handler installed before is called as before.
    """
    previous = mujoco.get_mju_user_warning()
    messages: list[str] = []
    mujoco.set_mju_user_warning(messages.append)
    try:
        with known_warnings_silenced():
            yield
    finally:
        mujoco.set_mju_user_warning(previous)
    # Only now: an exception (a warning made an error) must not cross MuJoCo's C code.
    for message in messages:
        if _KNOWN_MUJOCO_WARNING in message:
            continue
        if previous is not None:
            previous(message)
        else:
            warnings.warn(f"MuJoCo: {message}", UserWarning, stacklevel=3)


class _JaxOfThisProcess:
    """``jax`` whose devices are those of this process."""

    devices = staticmethod(jax.local_devices)

    def __getattr__(self, name: str) -> Any:
        return getattr(jax, name)


def load_onto_own_device(module: ModuleType) -> None:
    """Let a module that knows JAX as ``jax`` put arrays on a device of this process.

    MuJoCo XLA puts models on ``jax.devices()[0]``, which in a run of several processes is a device
    of the first one, where no other process can read it.
    """
    if jax.process_count() > 1 and vars(module)["jax"] is jax:
        vars(module)["jax"] = _JaxOfThisProcess()
