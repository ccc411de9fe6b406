"""Detect forks of a process in which JAX runs, where JAX would hang."""

from __future__ import annotations

import os
import sys

_FIX = (
    "PixelBrax was forked: JAX had started before this process was forked, and would hang here. "
    "Start workers with the 'spawn' or 'forkserver' method, e.g. "
    "gymnasium.vector.AsyncVectorEnv(..., context='spawn'); or better, use no workers: "
    "gymnasium.make_vec(id, num_envs=n) steps all environments in one process."
)


_forked = False


def _mark_child() -> None:
    global _forked
    bridge = sys.modules.get("jax._src.xla_bridge")
    # JAX has no public function for this. Without this one, assume that JAX runs.
    started = getattr(bridge, "backends_are_initialized", lambda: True)
    _forked = _forked or (bridge is not None and started())


if hasattr(os, "register_at_fork"):  # not on Windows, which cannot fork
    os.register_at_fork(after_in_child=_mark_child)


def is_forked() -> bool:
    """Return whether this process was forked after JAX had started."""
    return _forked


def check_not_forked() -> None:
    """Raise a RuntimeError in a forked process in which JAX would hang."""
    if _forked:
        raise RuntimeError(_FIX)
