"""Task name -> pixel environment and its parameters."""

from __future__ import annotations

import importlib
import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import jax
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.config import PROGRAM_OPTIONS, EnvConfig, env_config
from pixelbrax_jax.distractors.clips import ClipBank, load_clips, warn_procedural
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics import make_physics
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.scene.cameras import make_rig, rig_around, rigs_of, seen_from
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.tasks import DMC_TASKS, SUITES, TASKS
from pixelbrax_jax.types import Camera, CameraRig, Clips, EnvParams, GeomKind, Look
from pixelbrax_jax.validation import check_choice, suggest


@dataclass
class _OwnTask:
    """A task of the user's."""

    make_physics: Callable[[], Physics]
    camera: CameraRig | None

    @cached_property
    def physics(self) -> Physics:
        return self.make_physics()

    @cached_property
    def default_rig(self) -> CameraRig:
        own = getattr(self.physics, "rigs", {})
        return self.camera or own.get("default") or _corner_rig(self.physics)


_OWN_TASKS: dict[str, _OwnTask] = {}


def list_envs(suite: str | None = None) -> tuple[str, ...]:
    """Return the names that ``make`` accepts, sorted.

    Args:
        suite: ``"brax"`` or ``"dmc"`` (the DM Control Suite) for the tasks of one; None for all,
            also those that were registered.

    Raises:
        ValueError: there is no such suite.
    """
    if suite is None:
        return tuple(sorted([*TASKS, *_OWN_TASKS]))
    return tuple(sorted(SUITES[check_choice("suite", suite, SUITES)]))


def register(
    name: str,
    make_physics: Callable[[], Physics],
    *,
    camera: CameraRig | Camera | None = None,
) -> None:
    """Add a task of your own, from a Brax environment, an MJCF file or your own ``Physics``.

    Args:
        name: what ``make`` shall call it; must be new.
        make_physics: builds the physics, e.g. ``lambda: BraxPhysics(MyEnv())`` or
            ``lambda: mjcf_physics("arm.xml", reward=my_reward)``. Called once, by the first
            ``make``.
        camera: default viewpoint; None is the model's camera ``default``, or without it a look from
            a corner at everything but the ground, following the first body of what actuators move.

    Raises:
        ValueError: the name is taken or empty.
        TypeError: ``make_physics`` is not callable, or ``camera`` is of another type.
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"a task needs a name, got {name!r}.")
    if name in list_envs():
        raise ValueError(f"task {name!r} is registered already; choose another name.")
    if not callable(make_physics):
        raise TypeError("make_physics must be a function that returns a Physics.")
    if not isinstance(camera, CameraRig | Camera | None):
        raise TypeError(f"camera must be a CameraRig, a Camera or None, got {camera!r}.")
    _OWN_TASKS[name] = _OwnTask(make_physics, None if camera is None else make_rig(name, camera))


@default_flags()
def make(task: str | EnvConfig, **options: Any) -> tuple[PixelEnv, EnvParams]:
    """Make a pixel environment and its parameters.

    Environments made of equal options are equal, and share compiled programs. Those that differ
    in nothing but camera, look, time limit or clips are equal too: these are parameters.

    Args:
        task: one of ``list_envs()``; or ``"module:name"``, a task that importing the module
            registers; or an ``EnvConfig``, of which ``options`` are changed.
        **options: the fields of ``EnvConfig``, which says what they are.

    Returns:
        The environment and its parameters.

    Raises:
        ValueError: a name is unknown or a number out of range; the message lists what is allowed.
        TypeError: there is no such option; the message lists them and names the nearest one.
        ImportError: the task is of the DM Control Suite, and dm_control is not installed; the
            message has the line that installs it. Or the module of a task cannot be imported.
        FileNotFoundError: clips are missing.
        MemoryError: the clips would take too much memory.
        RuntimeError: JAX has no device to compute on.
    """
    config = _registered(env_config(task, options))
    _check_device()
    physics = _physics(config)
    program = {name: getattr(config, name) for name in PROGRAM_OPTIONS}
    program["distractors"] = resolve(config.distractors, config.task)
    env = PixelEnv(physics, **program)
    rig = _rig(config, physics)
    if not rig.link < len(physics.link_names):
        raise ValueError(
            f"the camera follows link {rig.link}, but task {config.task!r} has only "
            f"{len(physics.link_names)} links: {', '.join(physics.link_names)}."
        )
    params = EnvParams(
        geoms=seen_from(physics.geoms, rig),
        rig=rig,
        look=_look(config, physics),
        episode_length=np.int32(config.episode_length),
    )
    # Here, so that no program has to: JAX may be told to refuse that (`jax.transfer_guard`).
    return env, jax.device_put(params).replace(clips=_clips(config, env))


def _check_device() -> None:
    """Start JAX, whose own error may be without a word.

    Raises:
        RuntimeError: it finds no device; the message names what was asked for, and has the fix.
    """
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS")
        raise RuntimeError(
            "JAX finds no device to compute on"
            + (f" with JAX_PLATFORMS={asked}; unset it" if asked else "; run pixelbrax doctor")
            + f", or {install_extra('cuda12', 'cuda13')}"
            + (f" ({error})." if str(error) else ".")
        ) from error


@default_flags()
def named_rigs(task: str) -> dict[str, CameraRig]:
    """Return the viewpoints of a task by name, which ``camera=`` takes.

    Args:
        task: as ``make`` takes it.

    Returns:
        ``default``, ``side`` (seen along +y), ``front`` (along -x), ``top`` (from above, +y up in
        the image); ``original`` where the paper has the task; of the DM Control Suite and of tasks
        of your own the model's cameras that keep their orientation, also in place of others of
        that name.

    Raises:
        ValueError: the task is unknown.
        ImportError: as in ``make``.
    """
    config = _registered(env_config(task, {}))
    return rigs_of(config.task, _own_rigs(config.task, _physics(config)))


_parameters = [
    inspect.Parameter(
        field.name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD
        if field.name == "task"
        else inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if field.name == "task" else field.default,
        annotation=field.type,
    )
    for field in fields(EnvConfig)
]
# What help() and editors show.
make.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    sorted(_parameters, key=lambda parameter: parameter.kind)
)


def _registered(config: EnvConfig) -> EnvConfig:
    """Return the options with the bare name of the task, the module of which is imported.

    Raises:
        ValueError: the module's name is none, or it registers no task of that name.
        ImportError: the module cannot be imported.
    """
    task = config.task
    if not isinstance(task, str) or ":" not in task or task in list_envs():
        return config
    module, _, name = task.partition(":")
    if not all(part.isidentifier() for part in module.split(".")):
        raise ValueError(
            f"task {task!r} must be NAME or MODULE:NAME, with the module as 'import' has it, such "
            "as my_tasks:my_swing for a file my_tasks.py."
        )
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError)
        if not (missing and f"{module}.".startswith(f"{error.name}.")):
            raise ImportError(
                f"module {module!r} of task {task!r} cannot be imported: {error}"
            ) from error
        here = sorted(path.stem for path in Path.cwd().glob("*.py"))
        raise ModuleNotFoundError(
            f"there is no module {error.name!r}, which task {task!r} names: its folder must be the "
            f"current one, {Path.cwd()}, or in PYTHONPATH.{suggest(module, here)}",
            name=error.name,
        ) from error
    if name not in _OWN_TASKS:
        own = ", ".join(sorted(_OWN_TASKS)) or "none"
        raise ValueError(
            f"module {module!r} ({getattr(found, '__file__', None)}) registers no task {name!r}; "
            f"registered are: {own}.{suggest(name, _OWN_TASKS)}"
        )
    return replace(config, task=name)


def _physics(config: EnvConfig) -> Physics:
    check_choice("task", config.task, list_envs(), meant=_meant(config.task))
    if config.task in TASKS:
        return make_physics(config.task, backend=config.backend, reward_preset=config.reward_preset)
    if config.backend is not None or config.reward_preset != "brax":
        raise ValueError(
            f"task {config.task!r} was registered with its own physics: choose its backend and "
            "reward there, not in make()."
        )
    return _OWN_TASKS[config.task].physics


def _meant(task: object) -> str | None:
    """Return the task that is meant by Gymnasium's name, or by DM Control's in other libraries."""
    for full, row in TASKS.items():
        if task == row.gymnasium_id:
            return full
    name = str(task).lower().replace("-", "_").removeprefix("dmc_")
    found = [full for full, row in DMC_TASKS.items() if name in (full, full[4:], row.task)]
    return found[0] if len(found) == 1 else None


def _own_rigs(task: str, physics: Physics) -> Mapping[str, CameraRig]:
    """Return the viewpoints of a task that its row has not."""
    rigs: Mapping[str, CameraRig] = getattr(physics, "rigs", {})
    return {**rigs, "default": _OWN_TASKS[task].default_rig} if task in _OWN_TASKS else rigs


def _rig(config: EnvConfig, physics: Physics) -> CameraRig:
    rigs = _own_rigs(config.task, physics)
    unfit: Mapping[str, str] = getattr(physics, "unfit_cameras", {})
    if isinstance(config.camera, str) and config.camera in set(unfit) - set(
        rigs_of(config.task, rigs)
    ):
        raise ValueError(
            f"camera {config.camera!r} of task {config.task!r} cannot be a viewpoint: "
            f"{unfit[config.camera]}, and a viewpoint is a perspective that keeps its direction. "
            f"Allowed: {', '.join(sorted(rigs_of(config.task, rigs)))}, a CameraRig or a Camera."
        )
    return make_rig(config.task, config.camera, rigs)


def _look(config: EnvConfig, physics: Physics) -> Look:
    """Return the look; the default one of a task of the DM Control Suite is its model's own."""
    own = config.task in DMC_TASKS and config.look == "default"
    return make_look(
        "dmc" if own else config.look,
        shadows=config.shadows,
        own=getattr(physics, "look", None),
    )


def _clips(config: EnvConfig, env: PixelEnv) -> Clips | None:
    """Return the clips on the device, None where nothing plays any."""
    clips, split = config.clips, config.split
    videos = [link for link in env.chain.links if isinstance(link, Video)]
    if clips is not None and not videos and env.obs_mode != "state":
        raise ValueError("clips are given, but no video is: add 'video' to the distractors.")
    if split != "train" and not config.distractors:
        raise ValueError(
            f"split={split!r} is given, but no distractor is: add one that has splits, such as "
            "'video', to the distractors."
        )
    if not videos:
        return None
    if isinstance(clips, ClipBank):
        if split not in ("train", clips.split):
            raise ValueError(f"split={split!r}, but the clips are of split {clips.split!r}.")
        return _on_device(clips)
    if clips is None:
        warn_procedural()
        clips = "procedural"
    bank = load_clips(
        clips, split, height=env.height, width=env.width, num_clips=videos[0].num_clips
    )
    return _on_device(bank)


# Weakly, so that clips leave the device with the last environment that shows them.
_resident: WeakValueDictionary[str, Clips] = WeakValueDictionary()


def _on_device(bank: ClipBank) -> Clips:
    """Return the clips on the device, where equal ones are once."""
    clips = _resident.get(bank.digest)
    if clips is None:
        clips = _resident[bank.digest] = bank.to_device()
    return clips


def _corner_rig(physics: Physics) -> CameraRig:
    state = physics.reset(jax.random.key(0))
    geoms, xpos, xquat = physics.geoms, np.asarray(state.xpos), np.asarray(state.xquat)
    points = [
        geoms.pos[g] if link < 0 else xpos[link] + spatial.rotate(xquat[link], geoms.pos[g])
        for g, link in enumerate(geoms.link)
        if geoms.kind[g] != GeomKind.PLANE
    ]
    link = int(getattr(physics, "followed_link", 0))
    around = rig_around(
        np.stack([np.asarray(p) for p in points] + list(xpos[link : link + 1])), link
    )
    # `rig_around` wants the target relative to the link it follows.
    shift = np.array([xpos[link, 0], xpos[link, 1], 0.0], np.float32)
    return around.replace(eye=around.eye - shift, target=around.target - shift)
