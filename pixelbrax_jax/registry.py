"""Built-in and registered tasks by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics.base import Physics, check_physics
from pixelbrax_jax.tasks import SUITES, TASKS
from pixelbrax_jax.types import Camera, CameraRig
from pixelbrax_jax.validation import check_choice, suggest

_OWN_TASKS: dict[str, tuple[Callable[[], Physics], CameraRig | Camera | None]] = {}
"""Registered tasks: functions that make physics at the first call, and viewpoints."""


def list_envs(suite: str | None = None) -> tuple[str, ...]:
    """Return the names that ``make`` accepts, sorted.

    ``suite`` is ``"brax"``, ``"dmc"`` (the DM Control Suite), ``"gym"`` (Gymnasium's MuJoCo tasks)
    or None for all tasks, including registered ones; others raise ValueError.
    """
    if suite is None:
        return tuple(sorted([*TASKS, *_OWN_TASKS]))
    return tuple(sorted(SUITES[check_choice("suite", suite, SUITES)].tasks))


def register(
    name: str,
    make_physics: Callable[[], Physics],
    *,
    camera: CameraRig | Camera | None = None,
) -> None:
    """Register a task made of a Brax environment, an MJCF file or your own ``Physics``.

    Args:
        name: new name of the task.
        make_physics: builds the physics, e.g. ``lambda: BraxPhysics(MyEnv())``. The first ``make``
            calls it once.
        camera: default viewpoint. None takes the rig ``default`` of the physics; without one a view
            from a corner shows all geoms but the ground and follows ``Physics.followed_link``.

    Raises:
        ValueError: the name is taken or empty.
        TypeError: ``make_physics`` is not callable, or ``camera`` has another type.
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"a task needs a name, got {name!r}.")
    if name in list_envs():
        raise ValueError(f"task {name!r} is registered already; choose another name.")
    if not callable(make_physics):
        raise TypeError("make_physics must be a function that returns a Physics.")
    if not isinstance(camera, CameraRig | Camera | None):
        raise TypeError(f"camera must be a CameraRig, a Camera or None, got {camera!r}.")
    _OWN_TASKS[name] = cache(lambda: check_physics(make_physics())), camera


@default_flags()
def make_physics(task: str, **options: Any) -> Physics:
    """Make the physics of a task with options of its suite. Equal arguments give equal objects."""
    check_choice("task", task, list_envs(), meant=_meant(task))
    own = _OWN_TASKS.get(task)
    folder, suite = next(((f, s) for f, s in SUITES.items() if task in s.tasks), ("", None))
    for name, value in options.items():
        if suite is None or not hasattr(suite.options, name):
            takers = [other.title for other in SUITES.values() if hasattr(other.options, name)]
            fix = "leave it out"
            if own is not None:
                fix += ", or give it where the task's physics is made, if that takes it"
            raise ValueError(
                f"{name}={value!r} is only for {' and '.join(takers)}, not for task {task!r}: "
                f"{fix}."
            )
    if own is not None:
        return own[0]()
    assert suite is not None
    loader = importlib.import_module(f"pixelbrax_jax.physics.{folder}.loading")
    physics: Physics = loader.load(task, suite.options(**options))
    return physics


def registered_camera(task: str) -> CameraRig | Camera | None:
    """Return the viewpoint that a task was registered with."""
    return _OWN_TASKS.get(task, (None, None))[1]


def find_task(task: str) -> str:
    """Return the name of a task; for ``module:name``, first import the module that registers it."""
    if not isinstance(task, str) or ":" not in task or task in list_envs():
        return task
    module, _, name = task.partition(":")
    if not all(part.isidentifier() for part in module.split(".")):
        raise ValueError(
            f"task {task!r} must be NAME or MODULE:NAME, with the module's name as in 'import', "
            "such as my_tasks:my_swing for a file my_tasks.py."
        )
    found = _import(module, task)
    if name not in _OWN_TASKS:
        own = ", ".join(sorted(_OWN_TASKS)) or "none"
        raise ValueError(
            f"module {module!r} ({found.__spec__ and found.__spec__.origin}) registers no task "
            f"{name!r}; registered tasks: {own}.{suggest(name, _OWN_TASKS)}"
        )
    return name


def _import(module: str, task: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError)
        if not (missing and f"{module}.".startswith(f"{error.name}.")):
            raise ImportError(
                f"module {module!r} of task {task!r} cannot be imported: {error}"
            ) from error
        here = sorted(path.stem for path in Path.cwd().glob("*.py"))
        raise ModuleNotFoundError(
            f"there is no module {error.name!r} for task {task!r}: its folder must be the "
            f"current one, {Path.cwd()}, or in PYTHONPATH.{suggest(module, here)}",
            name=error.name,
        ) from error


def _meant(task: object) -> str | None:
    """Return the only task that another library calls by this name, if there is exactly one."""
    rows = TASKS.items()
    names = {own: map(_plain, (row.gymnasium_id, *row.other_names)) for own, row in rows}
    found = [own for own, others in names.items() if _plain(task) in others]
    return found[0] if len(found) == 1 else None


def _plain(name: object) -> str:
    return str(name).lower().replace("-", "_")
