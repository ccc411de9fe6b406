"""Import of MuJoCo without OpenGL: ``from pixelbrax_jax.physics.opengl import mujoco``.

MuJoCo loads OpenGL while it is imported, and never later, so that ``mujoco.Renderer`` would fail
without it. A ``__getattr__`` in its modules therefore loads ``GLContext`` at its first use.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

_VARIABLE = "MUJOCO_GL"
_CONTEXT = "GLContext"
_HOME = "mujoco.rendering.classic.gl_context"
"""MuJoCo's module that loads OpenGL according to ``MUJOCO_GL`` at import."""


def import_mujoco() -> None:
    """Import MuJoCo without the OpenGL of ``MUJOCO_GL``, unless it is already imported.

    MuJoCo cannot be imported if that OpenGL is missing or unknown. ``mujoco.GLContext`` is loaded
    at its first use, also by ``mujoco.Renderer``, with the value of the variable and the errors of
    MuJoCo's import at that time. A MuJoCo that loads OpenGL elsewhere is not changed.
    """
    if "mujoco" in sys.modules or not _is_there():
        return
    chosen = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "disable"
    try:
        modules = [importlib.import_module("mujoco")]
        with contextlib.suppress(ImportError):
            modules.append(importlib.import_module("mujoco.gl_context"))
    finally:
        if chosen is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = chosen
    home = sys.modules.get(_HOME)
    if home is not None:
        for module in (*modules, home):
            vars(module)["__getattr__"] = _load_of(module, home)


def _is_there() -> bool:
    """Return whether MuJoCo has the module that loads OpenGL, without importing it."""
    spec = importlib.util.find_spec("mujoco")
    folders = (spec and spec.submodule_search_locations) or ()
    place = Path(*_HOME.split(".")[1:]).with_suffix(".py")
    return any(Path(folder, place).is_file() for folder in folders)


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
