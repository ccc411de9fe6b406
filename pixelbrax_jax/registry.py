"""Task name -> pixel environment and its parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from os import PathLike
from pathlib import Path
from weakref import WeakValueDictionary

import jax
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.choices import check_choice, checks_options
from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.clips import ClipBank, load_clips, warn_procedural
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.physics.tasks import REWARD_PRESETS, TASKS, make_physics
from pixelbrax_jax.scene.cameras import make_rig, rig_around
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.types import Camera, CameraRig, Clips, EnvParams, GeomKind, Look


@dataclass(frozen=True)
class _Entry:
    """How to build a task's physics; ``make_physics(backend=..., reward_preset=...)``."""

    make_physics: Callable[..., Physics]
    camera: CameraRig | None


_REGISTRY: dict[str, _Entry] = {
    name: _Entry(partial(make_physics, name), camera=None) for name in TASKS
}


def list_envs() -> tuple[str, ...]:
    """Names that ``make`` accepts, sorted."""
    return tuple(sorted(_REGISTRY))


def register(
    name: str,
    make_physics: Callable[[], Physics],
    *,
    camera: CameraRig | Camera | None = None,
) -> None:
    """Adds a task of your own, from a Brax environment, an MJCF file or your own ``Physics``.

    Args:
        name: what ``make`` shall call it; must be new.
        make_physics: builds the physics, e.g. ``lambda: BraxPhysics(MyEnv())`` or
            ``lambda: mjcf_physics("arm.xml", reward=my_reward)``. Called on the first ``make``.
        camera: default viewpoint; None looks from a corner at everything but the ground.

    Raises:
        ValueError: the name is taken or empty.
        TypeError: ``make_physics`` is not callable.
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"a task needs a name, got {name!r}.")
    if name in _REGISTRY:
        raise ValueError(f"task {name!r} is registered already; choose another name.")
    if not callable(make_physics):
        raise TypeError("make_physics must be a function that returns a Physics.")

    def build(backend: str | None, reward_preset: str) -> Physics:
        if backend is not None or reward_preset != "brax":
            raise ValueError(
                f"task {name!r} was registered with its own physics: choose its backend and "
                "reward there, not in make()."
            )
        return make_physics()

    _REGISTRY[name] = _Entry(build, None if camera is None else make_rig(name, camera))


@checks_options
def make(
    task: str,
    *,
    backend: str | None = None,
    reward_preset: str = "brax",
    camera: str | CameraRig | Camera = "default",
    look: str | Look = "default",
    shadows: bool | None = None,
    height: int = 84,
    width: int = 84,
    frame_stack: int = 3,
    obs_mode: str = "pixels",
    action_repeat: int = 1,
    episode_length: int = 1000,
    renderer: str = "fused",
    distractors: str | Distractor | Iterable[str | Distractor] | None = (),
    clips: str | Path | ClipBank | None = None,
    split: str = "train",
) -> tuple[PixelEnv, EnvParams]:
    """A pixel environment and its parameters.

    Calls with equal options share one environment, and so its compiled programs.

    Args:
        task: one of ``list_envs()``.
        backend: physics backend, ``"spring"``, ``"positional"``, ``"generalized"`` or ``"mjx"``,
            as far as the task supports it; None takes the task's own.
        reward_preset: ``"brax"``, or ``"paper"`` for the rewards of arXiv 2502.00021.
        camera: a named rig, a ``CameraRig`` or a ``Camera``.
        look: ``"default"``, ``"original"`` or a ``Look``.
        shadows: whether geoms cast shadows; None keeps the look's own choice.
        height: pixels of a frame.
        width: pixels of a frame.
        frame_stack: frames in one observation.
        obs_mode: ``"pixels"``, ``"state"`` or ``"both"``.
        action_repeat: control steps per step.
        episode_length: time limit in control steps.
        renderer: ``"fused"`` or ``"reference"``.
        distractors: what changes the picture: a ``Distractor``, a name of
            ``distractors.presets.PRESETS``, or several of them.
        clips: what a video distractor plays: the folder of DAVIS-2017 or one with videos, a bank
            of ``load_clips``, or ``"procedural"``; None means ``"procedural"`` with a warning.
        split: which of the clips, ``"train"`` or ``"test"``; see ``load_clips``.

    Returns:
        The environment and its parameters.

    Raises:
        ValueError: a name is unknown or a number out of range; the message lists what is allowed.
        TypeError: there is no such option; the message lists them and names the nearest one.
        FileNotFoundError: clips are missing.
        MemoryError: the clips would take too much memory.
    """
    check_choice("task", task, _REGISTRY)
    _check_single(
        backend=backend,
        height=height,
        width=width,
        frame_stack=frame_stack,
        obs_mode=obs_mode,
        action_repeat=action_repeat,
        episode_length=episode_length,
        renderer=renderer,
        split=split,
    )
    check_choice("reward_preset", reward_preset, REWARD_PRESETS)
    links = resolve(distractors, task)
    env = _pixel_env(
        task,
        backend,
        reward_preset,
        height,
        width,
        frame_stack,
        obs_mode,
        action_repeat,
        episode_length,
        renderer,
        links,
    )
    videos = [link for link in env.distractors.links if isinstance(link, Video)]
    bank = _clips(clips, split, env.height, env.width, videos[0].num_clips) if videos else None
    if clips is not None and not videos and env.obs_mode != "state":
        raise ValueError("clips are given, but no video is: add 'video' to the distractors.")
    if split != "train" and not links:
        raise ValueError(
            f"split={split!r} is given, but no distractor is: add one that has splits, such as "
            "'video', to the distractors."
        )
    rig = make_rig(task, camera, _fallback_rig(task))
    if not rig.link < len(env.physics.link_names):
        raise ValueError(
            f"the camera follows link {rig.link}, but task {task!r} has only "
            f"{len(env.physics.link_names)} links: {', '.join(env.physics.link_names)}."
        )
    look = make_look(look, shadows=shadows)
    return env, EnvParams(geoms=env.physics.geoms, rig=rig, look=look, clips=bank)


def _check_single(**options: object) -> None:
    """Rejects lists and the like, which could not be looked up among the environments made."""
    for name, value in options.items():
        try:
            hash(value)
        except TypeError as error:
            raise TypeError(
                f"{name} must be a single value, got a {type(value).__name__}: {value!r}."
            ) from error


def _clips(
    clips: str | Path | ClipBank | None,
    split: str,
    height: int,
    width: int,
    num_clips: int | None,
) -> Clips:
    """Clips on the device; equal ones are there once."""
    if isinstance(clips, ClipBank):
        bank = clips
        if split not in ("train", bank.split):
            raise ValueError(f"split={split!r}, but the clips are of split {bank.split!r}.")
    else:
        if clips is None:
            warn_procedural()
            clips = "procedural"
        if not isinstance(clips, (str, PathLike)):
            raise TypeError(
                f"clips must be a folder, 'procedural' or a bank of load_clips, got {clips!r}."
            )
        bank = load_clips(clips, split, height=height, width=width, num_clips=num_clips)
    return _on_device(bank)


# Weakly, so that clips leave the device with the last environment that shows them.
_resident: WeakValueDictionary[str, Clips] = WeakValueDictionary()


def _on_device(bank: ClipBank) -> Clips:
    clips = _resident.get(bank.digest)
    if clips is None:
        clips = _resident[bank.digest] = bank.to_device()
    return clips


@cache
def _physics(task: str, backend: str | None, reward_preset: str) -> Physics:
    return _REGISTRY[task].make_physics(backend=backend, reward_preset=reward_preset)


# Typed, because True equals 1 and must not slip past the checks.
@lru_cache(maxsize=None, typed=True)
def _pixel_env(
    task: str,
    backend: str | None,
    reward_preset: str,
    height: int,
    width: int,
    frame_stack: int,
    obs_mode: str,
    action_repeat: int,
    episode_length: int,
    renderer: str,
    distractors: tuple[Distractor, ...],
) -> PixelEnv:
    return PixelEnv(
        _physics(task, backend, reward_preset),
        height=height,
        width=width,
        frame_stack=frame_stack,
        obs_mode=obs_mode,
        action_repeat=action_repeat,
        episode_length=episode_length,
        renderer=renderer,
        distractors=distractors,
    )


def _fallback_rig(task: str) -> CameraRig | None:
    """The default viewpoint of a task that the user registered; None for the built-in ones."""
    if task in TASKS:
        return None
    return _REGISTRY[task].camera or _corner_rig(task)


@cache
def _corner_rig(task: str) -> CameraRig:
    physics = _physics(task, None, "brax")
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
