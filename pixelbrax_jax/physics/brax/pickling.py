"""Brax's environments in a form that can be pickled: they hold the module of their backend."""

from __future__ import annotations

import copy
from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any, NamedTuple

from pixelbrax_jax.physics.mujoco_compatibility import import_silenced

with import_silenced():
    from brax import envs


class _Module(NamedTuple):
    name: str


def without_modules(env: envs.Env) -> envs.Env:
    """Return a copy of an environment and its wrappers with names in place of modules."""
    return _replace(env, ModuleType, lambda module: _Module(module.__name__))


def with_modules(env: envs.Env) -> envs.Env:
    """Return a copy of what ``without_modules`` returned with the modules in their places."""
    return _replace(env, _Module, lambda module: import_module(module.name))


def _replace(env: envs.Env, kind: type, by: Callable[[Any], Any]) -> envs.Env:
    changed = copy.copy(env)
    for name, value in vars(env).items():
        if isinstance(value, kind):
            setattr(changed, name, by(value))
        elif isinstance(value, envs.Env):
            setattr(changed, name, _replace(value, kind, by))
    return changed
