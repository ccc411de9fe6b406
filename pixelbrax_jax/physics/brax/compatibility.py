"""Where Brax and the current releases of JAX and MuJoCo disagree, and how we live with it.

Nothing here imports Brax. Each function states the disagreement it covers; when a release
ends one, its lines can go.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import sys
import warnings
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_KNOWN_WARNINGS: tuple[tuple[str, type[Warning]], ...] = (
    # Brax, at every load of a model.
    ("Brax System, piplines and environments are not actively", UserWarning),
    # Imported by Brax's generalized backend.
    ("JAXopt is no longer maintained", DeprecationWarning),
    # Brax reads MJX fields that moved; MJX still serves them.
    (r"Accessing `\w+` directly from `(Data|Model)` is deprecated", DeprecationWarning),
)
# Brax's half cheetah says settotalmass; the mass it gives is still the one MuJoCo uses.
_KNOWN_MUJOCO_WARNING = "compiler attribute 'settotalmass' is deprecated"
# MJX prints a line when an optional dependency, Warp, is not installed.
_KNOWN_PRINT = "Failed to import "


@contextlib.contextmanager
def known_warnings_silenced() -> Iterator[None]:
    """Hide Brax's own known warnings, and no others, while the block runs."""
    with warnings.catch_warnings():
        for message, category in _KNOWN_WARNINGS:
            warnings.filterwarnings("ignore", message=message, category=category)
        yield


@contextlib.contextmanager
def import_silenced() -> Iterator[None]:
    """Hide the known noise of importing Brax; print anything else afterwards."""
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


class _NumpyWithOldClip:
    """``jax.numpy`` whose ``clip`` still takes ``a_min`` and ``a_max``."""

    @staticmethod
    def clip(
        a: jax.Array,
        a_min: jax.typing.ArrayLike | None = None,
        a_max: jax.typing.ArrayLike | None = None,
    ) -> jax.Array:
        return jnp.clip(a, a_min, a_max)

    def __getattr__(self, name: str) -> Any:
        return getattr(jnp, name)


def accept_old_clip(module: ModuleType) -> None:
    """Let one module call ``jp.clip(x, a_min=...)``, which JAX no longer accepts.

    Brax's fluid forces (the swimmer) do. Only the name ``jp`` inside ``module`` is replaced,
    and only where JAX lacks the argument, so a call that used to raise now works and every
    other call in the process is untouched.

    Args:
        module: a module that knows ``jax.numpy`` as ``jp``.
    """
    if "a_min" not in inspect.signature(jnp.clip).parameters and vars(module)["jp"] is jnp:
        vars(module)["jp"] = _NumpyWithOldClip()


class _JaxWithReplicated:
    """``jax`` that still has ``device_put_replicated``."""

    @staticmethod
    def device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
        """Return ``x`` with a new leading axis, one row on each device."""
        sharding = NamedSharding(Mesh(np.array(devices), ("row",)), PartitionSpec("row"))

        def put(leaf: jax.typing.ArrayLike) -> jax.Array:
            rows = jnp.broadcast_to(leaf, (len(devices), *jnp.shape(leaf)))
            return jax.device_put(rows, sharding)

        return jax.tree.map(put, x)

    def __getattr__(self, name: str) -> Any:
        return getattr(jax, name)


def accept_device_put_replicated(module: ModuleType) -> None:
    """Let one module call ``jax.device_put_replicated``, which JAX no longer has.

    Brax's trainers do. Only the name ``jax`` inside ``module`` is replaced, and only where JAX
    lacks the function, so a call that used to raise now works and every other call in the
    process is untouched.

    Args:
        module: a module that knows JAX as ``jax``.
    """
    if not hasattr(jax, "device_put_replicated") and vars(module)["jax"] is jax:
        vars(module)["jax"] = _JaxWithReplicated()


class _JaxOfThisProcess:
    """``jax`` whose devices are those of this process."""

    devices = staticmethod(jax.local_devices)

    def __getattr__(self, name: str) -> Any:
        return getattr(jax, name)


def load_onto_own_device(module: ModuleType) -> None:
    """Let one module put arrays on a device of this process.

    MuJoCo XLA puts models on ``jax.devices()[0]``, which in a run of several processes is a device
    of the first one, where no other process can read it.

    Args:
        module: a module that knows JAX as ``jax``.
    """
    if jax.process_count() > 1 and vars(module)["jax"] is jax:
        vars(module)["jax"] = _JaxOfThisProcess()
