"""Task name -> pixel environment and its parameters."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
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
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics import make_physics
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.scene.cameras import make_rig, rig_around, rigs_of, seen_from
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.tasks import DMC_TASKS, SUITES, TASKS
from pixelbrax_jax.types import Camera, CameraRig, Clips, EnvParams, GeomKind, Look
from pixelbrax_jax.validation import check_choice


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
        return self.camera or _corner_rig(self.physics)


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
        camera: default viewpoint; None looks from a corner at everything but the ground.

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
        task: one of ``list_envs()``; or an ``EnvConfig``, of which ``options`` are changed.
        **options: the fields of ``EnvConfig``, which says what they are.

    Returns:
        The environment and its parameters.

    Raises:
        ValueError: a name is unknown or a number out of range; the message lists what is allowed.
        TypeError: there is no such option; the message lists them and names the nearest one.
        ImportError: the task is of the DM Control Suite, and dm_control is not installed; the
            message has the line that installs it.
        FileNotFoundError: clips are missing.
        MemoryError: the clips would take too much memory.
    """
    config = env_config(task, options)
    physics = _physics(config)
    program = {name: getattr(config, name) for name in PROGRAM_OPTIONS}
    program["distractors"] = resolve(config.distractors, config.task)
    env = PixelEnv(physics, **program)
    rig = make_rig(config.task, config.camera, _own_rigs(config.task, physics))
    if not rig.link < len(physics.link_names):
        raise ValueError(
            f"the camera follows link {rig.link}, but task {config.task!r} has only "
            f"{len(physics.link_names)} links: {', '.join(physics.link_names)}."
        )
    params = EnvParams(
        geoms=seen_from(physics.geoms, rig),
        rig=rig,
        look=_look(config, physics),
        clips=_clips(config, env),
        episode_length=np.int32(config.episode_length),
    )
    # Here, so that no program has to: JAX may be told to refuse that (`jax.transfer_guard`).
    return env, jax.device_put(params)


@default_flags()
def named_rigs(task: str) -> dict[str, CameraRig]:
    """Return the viewpoints of a task by name, which ``camera=`` takes.

    Args:
        task: one of ``list_envs()``.

    Returns:
        ``default``, ``side`` (seen along +y), ``front`` (along -x), ``top`` (from above, +y up in
        the image); ``original`` where the paper has the task; of the DM Control Suite the model's
        own cameras that keep their orientation, also in place of others of that name.

    Raises:
        ValueError: the task is unknown.
        ImportError: as in ``make``.
    """
    return rigs_of(task, _own_rigs(task, _physics(env_config(task, {}))))


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


def _own_rigs(task: str, physics: Physics) -> CameraRig | Mapping[str, CameraRig] | None:
    """Return the viewpoints of a task that its row has not."""
    if task in _OWN_TASKS:
        return _OWN_TASKS[task].default_rig
    return getattr(physics, "rigs", None)


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
    track_first = rig_around(np.stack([np.asarray(p) for p in points] + list(xpos[:1])))
    # `rig_around` wants the target relative to the link it follows.
    shift = np.array([xpos[0, 0], xpos[0, 1], 0.0], np.float32)
    return track_first.replace(eye=track_first.eye - shift, target=track_first.target - shift)
