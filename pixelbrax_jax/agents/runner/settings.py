"""Settings of a run, how they are stored, and with which of them a stored run may go on."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields
from importlib import metadata
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, check_count, check_positive, describe
from pixelbrax_jax.cache import whole_path
from pixelbrax_jax.config import ENV_OPTIONS
from pixelbrax_jax.types import Clips
from pixelbrax_jax.validation import check_choice, check_positive_int

RESUME = ("never", "latest")

FORMER_DEFAULTS: dict[str, Any] = {}
"""Values, by name, of settings in runs that do not store them, where those are not the defaults. A
default that changes is added here with its former value."""

OF_RUNS = ("seed", "seeds")
"""Settings of ``RunConfig`` that decide the result of a run."""

_PACKAGES = ("pixelbrax", "jax", "jaxlib", "brax", "mujoco", "flax", "optax")
"""Packages whose versions a run's last bits depend on."""

_GONE = {"physics_batching"}
"""Settings of former releases that changed no result."""

_FREE = ("total_steps", "memory_budget_gb")
"""Settings that a run may go on with although they differ."""


def _on_terminal() -> bool:
    return bool(getattr(sys.stderr, "isatty", bool)())


@dataclass(frozen=True)
class RunConfig:
    """What is done around the training; nothing but the seeds changes a bit of it.

    Raises:
        ValueError: a setting is out of range; the message says what is allowed.
    """

    output_dir: str = "runs/train"
    """Folder of logs, checkpoints and the policy."""
    seed: int = 0
    """Seed of the run."""
    seeds: int = 1
    """Runs in one program, of the seeds ``seed``, ``seed`` + 1, ..."""
    resume: str = "never"
    """``latest`` goes on from the latest checkpoint in the folder, if there is one."""
    log_training_metrics: bool = True
    """Whether metrics of the training itself are logged."""
    log_every: int = 1
    """Iterations that one record sums up."""
    num_evals: int = 0
    """Evaluations, evenly over the run, the last at its end; 0 never makes such environments."""
    eval_episodes: int = 32
    """Episodes of an evaluation, for each split."""
    checkpoint_every: int = 0
    """Control steps between checkpoints, besides those by the clock, at evaluations and at the end;
    0 writes no more than those."""
    checkpoint_minutes: float = 10.0
    """Minutes without a checkpoint after which one is written; 0 goes by no clock."""
    keep_checkpoints: int = 3
    """Latest checkpoints that are kept, besides the best."""
    wandb_project: str | None = None
    """Project of Weights & Biases; none writes nothing there."""
    progress: bool = field(default_factory=_on_terminal)
    """Whether a progress bar is shown; by default where stderr is a terminal."""

    def __post_init__(self) -> None:
        """Check the settings."""
        check_choice("resume", self.resume, RESUME)
        for name in ("seeds", "log_every", "eval_episodes", "keep_checkpoints"):
            check_positive_int(name, getattr(self, name))
        for name in ("seed", "num_evals", "checkpoint_every"):
            check_count(name, getattr(self, name))
        check_positive("checkpoint_minutes", self.checkpoint_minutes, or_zero=True)
        if self.seed + self.seeds > 2**32:
            raise ValueError(
                f"seeds must be below 2**32, got seed={self.seed} and seeds={self.seeds}."
            )


def describe_run(
    algorithm: Algorithm, options: RunConfig, clips: Sequence[str] = ()
) -> dict[str, Any]:
    """Return what decides the result of a run, as JSON has it: algorithm, settings, clips.

    ``clips`` are digests of what is played. Those of made clips are not stored: their name tells
    them, and they may differ in a pixel from one processor to the next.
    """
    settings = describe(algorithm.config) | {name: getattr(options, name) for name in OF_RUNS}
    settings["clips"] = place_of(settings["clips"])
    made = settings["clips"] in (None, "procedural")
    return {
        "algorithm": algorithm.name,
        "config": settings,
        "clips": None if made else list(clips) or None,
    }


def former_settings(kind: type[TrainConfig]) -> dict[str, Any]:
    """Return by name what a stored run had for settings that it lacks; ``kind`` is their class."""
    defaults = {field.name: field.default for field in (*fields(kind), *fields(RunConfig))}
    names = {*ENV_OPTIONS, *(field.name for field in fields(kind)), *OF_RUNS} - {"env"}
    known = vars(defaults["env"]) | defaults | FORMER_DEFAULTS
    plain = {n: list(v) if isinstance(v, tuple) else v for n, v in known.items() if n in names}
    return {name: value for name, value in plain.items() if value is not MISSING}


def versions() -> dict[str, str]:
    """Return versions of packages, and number and kind of devices."""
    found = {"devices": f"{jax.device_count()} x {jax.devices()[0].device_kind}"}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def unknown_settings(about: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """Return a sentence on what is stored in ``about`` and not ``known`` here; empty if nothing."""
    names = [name for name in about["config"] if name not in known and name not in _GONE]
    if not names:
        return ""
    written = about.get("versions", {}).get("pixelbrax", "another release")
    those = ", ".join(f"{name}={about['config'][name]!r}" for name in names)
    return (
        f"This release does not know {those}: the run was written by pixelbrax {written}; take "
        "that release or a later one. "
    )


def differences(about: Mapping[str, Any], own: Mapping[str, Any]) -> list[str]:
    """Return the settings with which a stored run may not go on, one line each.

    Both are of ``describe_run``: ``about`` as stored, ``own`` of the run that shall go on.
    """
    old, new = about["config"], own["config"]
    free = {name for name in _FREE if name != "total_steps" or not new.get("anneal")}
    found = []
    for name in sorted((old.keys() | new.keys()) - free - _GONE - {"clips"}):
        if name not in new:
            found.append(f"{name}: {old[name]!r} there, unknown here")
        elif old.get(name) != new[name]:
            found.append(f"{name}: {old.get(name)!r} there, {new[name]!r} here")
    there, here = (place_of(settings.get("clips")) or "procedural" for settings in (old, new))
    if about.get("clips") and own.get("clips"):
        if about["clips"] != own["clips"]:
            found.append(f"clips: those of {there!r} there, others in {here!r} here")
    elif there != here:
        named = there == "procedural" or about.get("clips")
        why = "" if named else " (it has no digest of its clips: the folder decides)"
        found.append(f"clips: {there!r} there, {here!r} here{why}")
    return found


def clip_digests(clips: Clips | None) -> list[str]:
    """Return a hash of the content of each clip, at its size, wherever it comes from."""
    if clips is None:
        return []
    pixels, *parts = jax.device_get((clips.packed, clips.first, clips.length))
    found = []
    for first, length in zip(*parts, strict=True):
        frames = np.ascontiguousarray(pixels[first : first + length])
        digest = hashlib.sha256(repr(frames.shape).encode())
        digest.update(frames.data)
        found.append(digest.hexdigest()[:32])
    return found


def place_of(clips: str | None) -> str | None:
    """Return where clips are, whatever the current folder will be."""
    if clips is None or clips == "procedural":
        return clips
    return str(whole_path(clips))
