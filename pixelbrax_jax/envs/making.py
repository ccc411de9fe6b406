"""Construction of pixel environments from options."""

from __future__ import annotations

import inspect
import math
import os
from dataclasses import replace
from functools import lru_cache
from typing import Any
from weakref import WeakValueDictionary

import jax
import numpy as np

from pixelbrax_jax import registry
from pixelbrax_jax.config import PROGRAM_OPTIONS, EnvConfig, env_config
from pixelbrax_jax.distractors.clips import ClipBank, load_clips, warn_procedural
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.ranges import as_arrays
from pixelbrax_jax.scene.cameras import choose_rig, rig_from_corner, seen_from, with_sides
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.types import CameraRig, Clips, DynamicsRanges, EnvParams, Look


@default_flags()
def make(task: str | EnvConfig, **options: Any) -> tuple[PixelEnv, EnvParams]:
    """Make a pixel environment and its parameters.

    Environments with equal options are equal, and share compiled programs. Camera, look, time limit
    and clips do not matter for equality, because they are parameters.

    Args:
        task: one of ``list_envs()``; ``"module:name"``, a task that importing the module registers;
            or an ``EnvConfig`` to change with ``options``.
        **options: the fields of ``EnvConfig``, documented there.

    Returns:
        The environment and its parameters.

    Raises:
        ValueError: a name is unknown, a number is out of range, or an option is for other tasks;
            the message says what is allowed.
        TypeError: an option is unknown; the message lists all options and the nearest name.
        ImportError: dm_control, needed for a task of the DM Control Suite, is not installed (the
            message has the command that installs it), or the task's module cannot be imported.
        FileNotFoundError: clips are missing.
        MemoryError: the clips do not fit into memory.
        RuntimeError: JAX has no device to compute on.
    """
    config = env_config(task, options)
    config = replace(config, task=registry.find_task(config.task))
    _check_device()
    physics = registry.make_physics(config.task, **config.suite_options())
    program = {name: getattr(config, name) for name in PROGRAM_OPTIONS}
    program["distractors"] = resolve(config.distractors, config.task)
    env = PixelEnv(physics, num_cameras=config.num_cameras, **program)
    rigs = tuple(_rig(config, camera, physics) for camera in config.cameras)
    params = EnvParams(
        geoms=seen_from(physics.geoms, *rigs),
        rig=rigs if len(rigs) > 1 else rigs[0],
        # Textures are averaged for the pixels of the first camera.
        look=_look(config, physics, float(rigs[0].fovy)),
        episode_length=np.int32(min(filter(None, (config.episode_length, physics.time_limit)))),
        dynamics=_dynamics(config, physics),
    )
    # Here, because a transfer in a program may be forbidden (`jax.transfer_guard`).
    return env, jax.device_put(params).replace(clips=_clips(config, env))


# For help() and editors.
_options = dict(inspect.signature(EnvConfig).parameters)
_task = _options.pop("task").replace(default=inspect.Parameter.empty)
make.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [_task, *(o.replace(kind=inspect.Parameter.KEYWORD_ONLY) for o in _options.values())]
)


@default_flags()
def named_rigs(task: str) -> dict[str, CameraRig]:
    """Return a task's viewpoints by name, for the option ``camera``.

    Args:
        task: as in ``make``.

    Returns:
        ``default``, ``side`` (looks along +y), ``front`` (along -x), ``top`` (from above, +y is up
        in the image), and ``original`` if the paper has the task. For tasks of the DM Control Suite
        and your own, also the model's cameras that keep their orientation; they replace others of
        the same name.

    Raises:
        ValueError: the task is unknown.
        ImportError: as in ``make``.
    """
    name = registry.find_task(env_config(task, {}).task)
    return _rigs(name, registry.make_physics(name))


def _rigs(task: str, physics: Physics) -> dict[str, CameraRig]:
    camera = registry.registered_camera(task)
    if camera is not None:
        default = choose_rig(task, camera, {})
    else:
        default = physics.rigs.get("default") or _corner_rig(physics)
    return with_sides({**physics.rigs, "default": default})


@lru_cache(maxsize=16)
def _corner_rig(physics: Physics) -> CameraRig:
    state = physics.reset(jax.random.key(0))
    xpos, xquat = np.asarray(state.xpos), np.asarray(state.xquat)
    return rig_from_corner(physics.geoms, xpos, xquat, physics.followed_link)


def _rig(config: EnvConfig, camera: Any, physics: Physics) -> CameraRig:
    rigs, unfit = _rigs(config.task, physics), physics.unfit_cameras
    if isinstance(camera, str) and camera in unfit and camera not in rigs:
        raise ValueError(
            f"camera {camera!r} of task {config.task!r} cannot be a viewpoint: {unfit[camera]}, "
            "but a viewpoint must be a perspective camera with a fixed direction. Allowed: "
            f"{', '.join(sorted(rigs))}, a CameraRig or a Camera."
        )
    rig = choose_rig(config.task, camera, rigs)
    if not rig.link < len(physics.link_names):
        raise ValueError(
            f"the camera follows link {rig.link}, but task {config.task!r} has only "
            f"{len(physics.link_names)} links: {', '.join(physics.link_names)}."
        )
    return rig


def _look(config: EnvConfig, physics: Physics, fovy: float) -> Look:
    look = config.look
    if physics.look is not None and isinstance(look, str):
        if look == "dmc":
            rays = config.height * math.isqrt(config.samples)
            pixel = 2.0 * math.tan(math.radians(fovy) / 2.0) / rays
            look = _detailed(physics, pixel) or look
        elif look in ("default", "dmc-plain"):
            look = physics.look
    return make_look(look, shadows=config.shadows)


@lru_cache(maxsize=16)
def _detailed(physics: Physics, pixel: float) -> Look | None:
    return physics.detailed_look(pixel)


def _dynamics(config: EnvConfig, physics: Physics) -> DynamicsRanges | None:
    if config.dynamics and not physics.varies:
        raise ValueError(
            f"dynamics={config.dynamics!r} is only for tasks that MuJoCo simulates, those of the "
            "DM Control Suite, of Gymnasium, and your own of mjcf_physics, not for task "
            f"{config.task!r}."
        )
    return as_arrays(config.dynamics)


def _check_device() -> None:
    """Start JAX; raise a RuntimeError with the fix if it has no device."""
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


def _clips(config: EnvConfig, env: PixelEnv) -> Clips | None:
    clips, split = config.clips, config.split
    videos = [link for link in env.chain.links if isinstance(link, Video)]
    if clips is not None and not videos and env.obs_mode != "state":
        raise ValueError("clips are given without a video: add 'video' to the distractors.")
    # A state has no images, and so no distractors.
    if split != "train" and not videos and (env.images or not config.distractors):
        raise ValueError(
            f"split={split!r} is given without a distractor that has splits: add one, such as "
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


# Weak references, so that clips leave the device with the last environment that shows them.
_resident: WeakValueDictionary[str, Clips] = WeakValueDictionary()


def _on_device(bank: ClipBank) -> Clips:
    """Return the clips on the device, shared by equal banks."""
    clips = _resident.get(bank.digest)
    if clips is None:
        clips = _resident[bank.digest] = bank.to_device()
    return clips
