"""MuJoCo without OpenGL, which nothing here needs, until somebody asks MuJoCo to draw.

MuJoCo decides about OpenGL once, while it is imported; imported without, it would have no
``GLContext`` for the rest of the process, and a user's own ``mujoco.Renderer`` would fail. So its
modules are given a ``__getattr__``, which loads the context when it is first asked for. Physics
takes MuJoCo from here: ``from pixelbrax_jax.physics.opengl import mujoco``.
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
"""MuJoCo's module that loads OpenGL as ``MUJOCO_GL`` says, while it is imported."""


def import_mujoco() -> None:
    """Import MuJoCo, if nobody has, without the OpenGL that ``MUJOCO_GL`` names.

    MuJoCo cannot be imported where that is missing, or is no name that it knows. What it draws
    with, ``mujoco.GLContext``, is loaded when it is first used, by ``mujoco.Renderer`` too, as the
    variable says then; it fails then as MuJoCo's import would have. A MuJoCo that loads OpenGL
    elsewhere is left to be imported as it is.
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
    """Return whether MuJoCo has the module that loads OpenGL, without importing anything."""
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
