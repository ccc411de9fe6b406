"""Silenced warnings and prints of MuJoCo, MuJoCo XLA and Brax."""

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
# Both suites' cheetahs use settotalmass, which MuJoCo still applies.
_KNOWN_MUJOCO_WARNING = "compiler attribute 'settotalmass' is deprecated"
# MJX prints a line when an optional dependency, Warp, is not installed.
_KNOWN_PRINT = "Failed to import "


@contextlib.contextmanager
def known_warnings_silenced() -> Iterator[None]:
    """Hide known warnings of Brax and its dependencies in this block."""
    with warnings.catch_warnings():
        for message, category in _KNOWN_WARNINGS:
            warnings.filterwarnings("ignore", message=message, category=category)
        yield


@contextlib.contextmanager
def import_silenced() -> Iterator[None]:
    """Hide known output of importing Brax and MuJoCo XLA; print everything else afterwards."""
    printed = io.StringIO()
    with known_warnings_silenced(), contextlib.redirect_stdout(printed):
        yield
    for line in printed.getvalue().splitlines(keepends=True):
        if not line.startswith(_KNOWN_PRINT):
            sys.stdout.write(line)


@contextlib.contextmanager
def loading_silenced() -> Iterator[None]:
    """Hide known warnings of compiling a model; turn MuJoCo's others into Python warnings.

    Without a handler MuJoCo appends its warnings to ``MUJOCO_LOG.TXT`` in the working directory. A
    handler that was installed before is still called.
    """
    previous = mujoco.get_mju_user_warning()
    messages: list[str] = []
    mujoco.set_mju_user_warning(messages.append)
    try:
        with known_warnings_silenced():
            yield
    finally:
        mujoco.set_mju_user_warning(previous)
    # After the block, because an exception (a warning as error) must not cross MuJoCo's C code.
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
    """Let a module that uses ``jax`` put arrays on a device of this process.

    MuJoCo XLA puts models on ``jax.devices()[0]``, which in a run of several processes belongs to
    the first one; others cannot read it.
    """
    if jax.process_count() > 1 and vars(module)["jax"] is jax:
        vars(module)["jax"] = _JaxOfThisProcess()
