"""Every option of an environment: once, with its default and its documentation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

import jax

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.clips import ClipBank
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.physics.brax.tasks import BraxOptions
from pixelbrax_jax.plain import from_plain
from pixelbrax_jax.renderer.base import check_renderer
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.types import Camera, CameraRig, Look
from pixelbrax_jax.validation import check_bool, check_choice, check_options, check_positive_int

OBS_MODES = ("pixels", "state", "both")

Distractors = str | Distractor | Iterable[str | Distractor] | None


@dataclass(frozen=True, kw_only=True)
class ProgramConfig:
    """Options that decide which program is compiled.

    Raises:
        ValueError: an option is out of range; the message says what is allowed.
        TypeError: an option is of another type, or an array or tracer.
    """

    height: int = 84
    """Pixels of a frame."""
    width: int = 84
    """Pixels of a frame."""
    frame_stack: int = 3
    """Frames in one observation."""
    obs_mode: str = "pixels"
    """What an observation is: ``pixels``, ``state`` (nothing is rendered) or ``both``."""
    action_repeat: int = 1
    """Control steps per step; one frame is drawn at their end."""
    renderer: str = "auto"
    """``auto``, the fastest for the device; ``fused``, for all devices; ``pallas``, the kernel for
    NVIDIA GPUs that ``auto`` takes there if it passes a check; or ``reference``, the slow one that
    the others are tested against."""
    distractors: Distractors = ()
    """What changes the image: a distractor, the name of a preset, or several of them; as
    everywhere, a dictionary of ``plain.to_plain`` in place of an object."""

    def __post_init__(self) -> None:
        """Check the options, and store them as Python's own types."""
        for name in ("height", "width", "frame_stack", "action_repeat"):
            self._store(name, check_positive_int(name, self._static(name)))
        check_choice("obs_mode", self._static("obs_mode"), OBS_MODES)
        check_renderer(self._static("renderer"))
        self._store("distractors", as_tuple(from_plain(self.distractors)))

    def _static(self, name: str) -> Any:
        """Return an option that decides which program is compiled.

        Raises:
            TypeError: it is an array, or cannot be hashed.
        """
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


_SUITE_OPTIONS = fields(BraxOptions)


@dataclass(frozen=True)
class EnvConfig(BraxOptions, ProgramConfig):
    """All options of an environment; ``pixelbrax_jax.make(task, **options)`` takes them.

    Raises:
        ValueError: an option is out of range; the message says what is allowed.
        TypeError: an option is of another type, or an array or tracer.
    """

    task: str = "ant"
    """Task, one of ``pixelbrax_jax.list_envs()``; or ``module:name``, which imports the module that
    registers it."""
    camera: str | CameraRig | Camera = "default"
    """Viewpoint: a name of ``named_rigs``, a ``CameraRig`` or a ``Camera``."""
    look: str | Look = "default"
    """Light, sky and ground: ``default``, ``original``, ``dmc`` or a ``Look``. For a task of the DM
    Control Suite ``default`` is ``dmc``, with its model's own lights."""
    shadows: bool | None = None
    """Whether geoms cast shadows; None keeps the look's own choice."""
    episode_length: int = 1000
    """Time limit in control steps."""
    clips: str | PathLike[str] | ClipBank | None = None
    """What a video distractor plays: the folder of DAVIS-2017 or one with videos, a bank of
    ``load_clips``, or ``procedural``; None means ``procedural`` with a warning."""
    split: str = "train"
    """Which of the clips: ``train``, ``test`` or another of their splits; see ``load_clips``."""

    def __post_init__(self) -> None:
        """Check the options, and store them as Python's own types."""
        ProgramConfig.__post_init__(self)
        for name in ("task", "split", *(option.name for option in _SUITE_OPTIONS)):
            self._static(name)
        BraxOptions.__post_init__(self)
        episode_length = check_positive_int("episode_length", self._static("episode_length"))
        self._store("episode_length", episode_length)
        if self.shadows is not None:
            self._store("shadows", check_bool("shadows", self.shadows))
        self._store("camera", from_plain(self.camera))
        self._store("look", from_plain(self.look))
        make_look(self.look)
        if self.clips is not None and not isinstance(self.clips, (str, PathLike, ClipBank)):
            raise TypeError(
                f"clips must be a folder, 'procedural' or a bank of load_clips, got {self.clips!r}."
            )

    def suite_options(self) -> dict[str, Any]:
        """Return those options of single suites that are not at their defaults."""
        values = {option.name: getattr(self, option.name) for option in _SUITE_OPTIONS}
        return {o.name: values[o.name] for o in _SUITE_OPTIONS if values[o.name] != o.default}


PROGRAM_OPTIONS = tuple(field.name for field in fields(ProgramConfig))
ENV_OPTIONS = tuple(field.name for field in fields(EnvConfig))


def env_config(
    base: str | EnvConfig, options: Mapping[str, Any], also_allowed: Iterable[str] = ()
) -> EnvConfig:
    """Return the options of an environment.

    Args:
        base: a task, whose other options have their defaults; or options to start from, also as
            a subclass, whose further fields are left out.
        options: by name, those that differ.
        also_allowed: names of the caller's own options, for the message about an unknown one.

    Raises:
        TypeError: an option is unknown; the message lists those there are and names the nearest.
        ValueError: an option is out of range; the message says what is allowed.
    """
    names = [name for name in ENV_OPTIONS if name != "task"]
    check_options(options, [*names, *also_allowed])
    if not isinstance(base, EnvConfig):
        return EnvConfig(task=base, **options)
    return EnvConfig(**({name: getattr(base, name) for name in ENV_OPTIONS} | dict(options)))
