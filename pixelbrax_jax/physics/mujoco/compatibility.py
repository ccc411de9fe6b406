"""Known output of MuJoCo, MuJoCo XLA and Brax, and what they need of JAX; loads MuJoCo alone."""

from __future__ import annotations

import contextlib
import io
import sys
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax.physics.mujoco.opengl import mujoco

# Both suites' cheetahs use settotalmass, which MuJoCo still applies.
_KNOWN_MUJOCO_WARNING = "compiler attribute 'settotalmass' is deprecated"
_KNOWN_WARNINGS: tuple[tuple[str, type[Warning]], ...] = (
    (_KNOWN_MUJOCO_WARNING, UserWarning),
    # Brax, at every load of a model.
    ("Brax System, piplines and environments are not actively", UserWarning),
    # Imported by Brax's generalized backend.
    ("JAXopt is no longer maintained", DeprecationWarning),
    # Brax reads MJX fields that moved; MJX still serves them.
    (r"Accessing `\w+` directly from `(Data|Model)` is deprecated", DeprecationWarning),
)
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

    Without a handler MuJoCo writes them to ``MUJOCO_LOG.TXT``. A previous handler is still called.
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


def load_onto_own_device(module: ModuleType) -> None:
    """Let a module that uses ``jax`` put arrays on a device of this process.

    MuJoCo XLA uses ``jax.devices()[0]``, which in a run of several processes belongs to the first.
    """
    if jax.process_count() > 1:
        _replace_in(module, "jax", jax, devices=jax.local_devices)


def accept_old_clip(module: ModuleType) -> None:
    """Let a module call ``jp.clip(x, a_min=...)``, as Brax's fluid forces do."""

    def clip(a: Any, a_min: Any = None, a_max: Any = None) -> jax.Array:
        return jnp.clip(a, a_min, a_max)

    _replace_in(module, "jp", jnp, clip=clip)


def accept_device_put_replicated(module: ModuleType) -> None:
    """Let a module call ``jax.device_put_replicated``, as Brax's trainers do."""

    def device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
        """Return ``x`` with a new leading axis, one row on each device."""
        count = len(devices)
        rows = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), x)
        sharding = NamedSharding(Mesh(np.array(devices), ("row",)), PartitionSpec("row"))
        return jax.device_put(rows, sharding)

    _replace_in(module, "jax", jax, device_put_replicated=device_put_replicated)


def _replace_in(module: ModuleType, name: str, imported: ModuleType, **functions: Any) -> None:
    """Replace functions of an ``imported`` module, ``name`` in ``module``, only for ``module``."""
    if vars(module)[name] is imported:
        changed = ModuleType(imported.__name__)
        vars(changed).update(functions, __getattr__=partial(getattr, imported))
        vars(module)[name] = changed
