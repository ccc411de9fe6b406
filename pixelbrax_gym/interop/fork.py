"""A process forked after JAX has started threads hangs in its first computation: say so."""

from __future__ import annotations

import os
import sys

_FIX = (
    "PixelBrax was forked: this process is a fork of one in which JAX was running already, and "
    "JAX would hang here. Start workers with the 'spawn' or 'forkserver' method, e.g. "
    "gymnasium.vector.AsyncVectorEnv(..., context='spawn'); or better, leave workers out: "
    "gymnasium.make_vec(id, num_envs=n) steps all environments in one process."
)


class _Process:
    forked = False


def _jax_runs() -> bool:
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None:
        return False
    # There is no public function. Should this one be gone, assume the worse.
    started = getattr(bridge, "backends_are_initialized", None)
    return True if started is None else bool(started())


def _mark_child() -> None:
    _Process.forked = _Process.forked or _jax_runs()


if hasattr(os, "register_at_fork"):  # not on Windows, which cannot fork
    os.register_at_fork(after_in_child=_mark_child)


def is_forked() -> bool:
    """Return whether this process is a fork of one that had started JAX."""
    return _Process.forked


def check_not_forked() -> None:
    """Stop a forked worker before it hangs, by a RuntimeError with the fix."""
    if _Process.forked:
        raise RuntimeError(_FIX)
