"""Options of an environment, with their defaults and documentation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

import jax

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.clips import ClipBank
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.observations import (
    IMAGES,
    CameraSizes,
    check_camera_sizes,
    check_obs_mode,
    order_by_camera,
    parts_of,
)
from pixelbrax_jax.physics.brax.tasks import BraxOptions
from pixelbrax_jax.physics.mujoco.options import MujocoOptions
from pixelbrax_jax.plain import from_plain
from pixelbrax_jax.ranges import Ranges, check_ranges
from pixelbrax_jax.renderer.base import check_renderer, check_samples
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.types import Camera, CameraRig, Look
from pixelbrax_jax.validation import check_bool, check_options, check_positive_int

Distractors = str | Distractor | Iterable[str | Distractor] | None
View = str | CameraRig | Camera


@dataclass(frozen=True, kw_only=True)
class ProgramConfig:
    """Options that decide which program is compiled.

    Raises:
        ValueError: an option is out of range; the message says what is allowed.
        TypeError: an option has another type, or is an array or tracer.
    """

    height: int = 84
    """Height of a frame in pixels."""
    width: int = 84
    """Width of a frame in pixels."""
    camera_sizes: CameraSizes = ()
    """Height and width of each of several cameras' images by the camera's name, which is yours for
    a ``CameraRig`` or ``Camera``: ``{"front": (84, 84), "top": (48, 64)}``. An observation is then
    a dictionary with entries such as ``pixels/front``; ``height`` and ``width`` become the first
    camera's."""
    frame_stack: int = 3
    """Number of frames in one observation."""
    obs_mode: str = "pixels"
    """Content of an observation: ``pixels``, ``depth``, ``segmentation``, ``state`` (nothing is
    rendered), several joined by ``+`` such as ``pixels+depth``, or ``both``, pixels and state."""
    action_repeat: int = 1
    """Control steps per environment step. Rewards are summed; only the last one is rendered."""
    renderer: str = "auto"
    """``auto`` chooses the fastest renderer for the device, ``fused`` runs on all devices,
    ``pallas`` is a kernel for NVIDIA GPUs (``auto`` takes it there if it passes a check), and
    ``reference`` is the slow renderer that the others are tested against."""
    samples: int = 1
    """Rays per pixel, whose colors are averaged: 1, 4, 9 or 16. With more of them edges are
    smoother, and rendering takes that many times as long."""
    distractors: Distractors = ()
    """Changes of the image: a distractor, the name of a preset, or several of them. A dictionary of
    ``plain.to_plain`` may stand for a distractor. Where only the state is observed, they, their
    clips and split are left out."""

    def __post_init__(self) -> None:
        for name in ("height", "width", "frame_stack", "action_repeat"):
            self._store(name, check_positive_int(name, self._static(name)))
        self._store("obs_mode", check_obs_mode(self._static("obs_mode")))
        self._store_camera_sizes(check_camera_sizes(self.camera_sizes))
        if self.camera_sizes and not self.images:
            raise ValueError(
                f"camera_sizes need images, but obs_mode={self.obs_mode!r} has none: leave them "
                "out, or add 'pixels' to obs_mode."
            )
        check_renderer(self._static("renderer"))
        self._store("samples", check_samples(self._static("samples")))
        self._store("distractors", as_tuple(from_plain(self.distractors)))

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images in an observation; none with ``obs_mode="state"``."""
        return tuple(part for part in parts_of(self.obs_mode) if part in IMAGES)

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """``camera_sizes`` as heights and widths by name."""
        rows: Any = self.camera_sizes
        return {name: (height, width) for name, height, width in rows}

    def _store_camera_sizes(self, rows: tuple[tuple[str, int, int], ...]) -> None:
        self._store("camera_sizes", rows)
        for _, height, width in rows[:1]:
            self._store("height", height)
            self._store("width", width)

    def _static(self, name: str) -> Any:
        """Return an option, or raise TypeError if it is an array or cannot be hashed."""
        value = getattr(self, name)
        if isinstance(value, jax.Array):
            raise TypeError(
                f"{name} decides which program is compiled and must be a single value of Python, "
                f"got the array {value!r}."
            )
        try:
            hash(value)
        except TypeError as error:
            raise TypeError(
                f"{name} must be a single value, got a {type(value).__name__}: {value!r}."
            ) from error
        return value

    def _store(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)


_SUITE_OPTIONS = (*fields(BraxOptions), *fields(MujocoOptions))


@dataclass(frozen=True)
class EnvConfig(BraxOptions, MujocoOptions, ProgramConfig):
    """All options of an environment; ``pixelbrax_jax.make(task, **options)`` takes them.

    Raises the errors of ``ProgramConfig``.
    """

    task: str = "ant"
    """Name of the task, one of ``pixelbrax_jax.list_envs()``, or ``module:name``, which first
    imports the module that registers it."""
    camera: View | tuple[View, ...] = "default"
    """Viewpoint: a name of ``named_rigs``, a ``CameraRig`` or a ``Camera``; or a tuple of several,
    whose images are the channels of each frame, one camera after the other, without
    ``camera_sizes``."""
    look: str | Look = "default"
    """Light, sky and ground: ``default``, ``original``, ``dmc``, ``dmc-plain`` or a ``Look``. For a
    task of MuJoCo ``default`` is ``dmc-plain`` with the lights of its model; ``dmc`` is the picture
    of MuJoCo's renderer, with the texture of the sky and reflections, and takes longer."""
    shadows: bool | None = None
    """Whether geoms cast shadows. None keeps the choice of the look."""
    episode_length: int = 1000
    """Time limit in control steps. That of the task holds if it is shorter: 50 for Gymnasium's
    reacher, 100 for its pusher."""
    clips: str | PathLike[str] | ClipBank | None = None
    """Videos for the video distractors: a folder with DAVIS-2017 or with video files, a bank of
    ``load_clips``, or ``procedural``. None means ``procedural`` with a warning."""
    split: str = "train"
    """Split of the clips: ``train``, ``test`` or another one they have; see ``load_clips``."""
    dynamics: Ranges = ""
    """Multipliers of a MuJoCo task's ``friction``, ``mass``, ``damping``, ``gain`` and ``gravity``:
    ``friction=0.5:2,mass=1.2`` draws that of friction uniformly for each episode. In Python also
    ``{"friction": (0.5, 2), "mass": 1.2}``."""

    def __post_init__(self) -> None:
        ProgramConfig.__post_init__(self)
        for name in ("task", "split", *(option.name for option in _SUITE_OPTIONS)):
            self._static(name)
        BraxOptions.__post_init__(self)
        MujocoOptions.__post_init__(self)
        self._store("dynamics", check_ranges("dynamics", self.dynamics))
        episode_length = check_positive_int("episode_length", self._static("episode_length"))
        if episode_length >= 2**31:
            raise ValueError(f"episode_length must be below 2**31, got {episode_length}.")
        self._store("episode_length", episode_length)
        if self.shadows is not None:
            self._store("shadows", check_bool("shadows", self.shadows))
        self._store("camera", _check_camera(from_plain(self.camera)))
        if self.camera_sizes:
            self._store_camera_sizes(order_by_camera(self.camera_sizes, self.cameras))
        self._store("look", from_plain(self.look))
        make_look(self.look)
        if self.clips is not None and not isinstance(self.clips, (str, PathLike, ClipBank)):
            raise TypeError(
                f"clips must be a folder, 'procedural' or a bank of load_clips, got {self.clips!r}."
            )

    @property
    def cameras(self) -> tuple[View, ...]:
        """All viewpoints."""
        return self.camera if isinstance(self.camera, tuple) else (self.camera,)

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self.cameras)

    def suite_options(self) -> dict[str, Any]:
        """Return the options that belong to one suite and differ from their defaults."""
        given = ((option, getattr(self, option.name)) for option in _SUITE_OPTIONS)
        return {option.name: value for option, value in given if value != option.default}


def _check_camera(camera: Any) -> Any:
    """Return one view, or a tuple of at least two; raise ValueError for none or a repeated name."""
    if not isinstance(camera, tuple):
        return camera
    if not camera:
        raise ValueError("camera must name at least one viewpoint, got an empty tuple.")
    for name in camera:
        if isinstance(name, str) and camera.count(name) > 1:
            raise ValueError(f"camera={camera!r} has {name!r} twice; give each viewpoint once.")
    return camera if len(camera) > 1 else camera[0]


PROGRAM_OPTIONS = tuple(field.name for field in fields(ProgramConfig))
ENV_OPTIONS = tuple(field.name for field in fields(EnvConfig))


def env_config(
    base: str | EnvConfig, options: Mapping[str, Any], also_allowed: Iterable[str] = ()
) -> EnvConfig:
    """Return the options of ``base``, or the defaults for a task's name, with some changed.

    Fields that a subclass of ``EnvConfig`` adds are ignored. ``also_allowed`` are the caller's
    other options, for the message about an unknown one.
    """
    names = [name for name in ENV_OPTIONS if name != "task"]
    check_options(options, [*names, *also_allowed])
    if not isinstance(base, EnvConfig):
        return EnvConfig(task=base, **options)
    return EnvConfig(**({name: getattr(base, name) for name in ENV_OPTIONS} | dict(options)))
