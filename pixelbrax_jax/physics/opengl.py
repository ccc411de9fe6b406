"""MuJoCo without OpenGL, which nothing here needs, until somebody asks MuJoCo to draw."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
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
    variable says then; it fails then as MuJoCo's import would have.
    """
    if "mujoco" in sys.modules:
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
