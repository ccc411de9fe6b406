"""Import of MuJoCo without OpenGL: ``from pixelbrax_jax.physics.mujoco.opengl import mujoco``."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType
from typing import Any

_VARIABLE = "MUJOCO_GL"
_CONTEXT = "GLContext"
_HOME = "mujoco.rendering.classic.gl_context"
"""MuJoCo's module that loads OpenGL according to ``MUJOCO_GL`` at import."""


def import_mujoco() -> None:
    """Import MuJoCo without the OpenGL of ``MUJOCO_GL``, unless it is already imported.

    MuJoCo loads OpenGL only at import, and fails if it is missing. A ``__getattr__`` in its modules
    therefore loads ``mujoco.GLContext`` at its first use, also by ``mujoco.Renderer``, with
    MuJoCo's own errors.
    """
    if "mujoco" in sys.modules:
        return
    chosen = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "disable"
    try:
        modules = [importlib.import_module(name) for name in ("mujoco", "mujoco.gl_context", _HOME)]
    finally:
        if chosen is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = chosen
    for module in modules:
        vars(module)["__getattr__"] = _load_of(module, modules[-1])


def _load_of(module: ModuleType, home: ModuleType) -> Any:
    def load(name: str) -> Any:
        if name != _CONTEXT:
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        if name not in vars(home):
            importlib.reload(home)  # reads the variable again
        if name not in vars(home):
            raise AttributeError(f"{_VARIABLE}={os.environ.get(_VARIABLE)} means no {name}")
        context = vars(module)[name] = vars(home)[name]
        return context

    return load


import_mujoco()
import mujoco as mujoco  # noqa: E402
