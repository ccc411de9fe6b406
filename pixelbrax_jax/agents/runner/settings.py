"""Settings of a run, their stored form, and the settings with which a run may continue."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import jax

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import (
    Count,
    NotNegative,
    PositiveInt,
    TrainConfig,
    check_annotated,
    describe,
)
from pixelbrax_jax.paths import in_home, whole_path
from pixelbrax_jax.processor import name_cpu
from pixelbrax_jax.types import Clips
from pixelbrax_jax.validation import check_choice

OF_RUNS = ("seed", "seeds")
"""Settings of ``RunConfig`` that affect the result of a run."""

_PACKAGES = ("pixelbrax", "jax", "jaxlib", "brax", "mujoco", "flax", "optax")
"""Packages whose versions affect the bits of a run."""

_GONE = {"physics_batching"}
"""Settings of former releases that did not affect results."""


@dataclass(frozen=True)
class RunConfig:
    """Seeds, and settings of logs, checkpoints and evaluation, which do not affect the training."""

    output_dir: str = "runs/train"
    """Folder for logs, checkpoints and the policy."""
    seed: Count = 0
    """Seed of the run."""
    seeds: PositiveInt = 1
    """Number of runs in one program, with the seeds ``seed``, ``seed`` + 1, ..."""
    resume: str = "never"
    """``latest`` continues from the latest checkpoint in the folder, if it has one."""
    log_training_metrics: bool = True
    """Logs the metrics of the training."""
    log_every: PositiveInt = 1
    """Number of iterations that one record summarises."""
    num_evals: Count = 0
    """Number of evaluations, evenly over the run, the last one at its end; 0 disables them."""
    eval_episodes: PositiveInt = 32
    """Number of episodes per evaluation and split."""
    checkpoint_every: Count = 0
    """Writes a checkpoint every so many control steps, besides those by the clock, at evaluations
    and at the end; 0 disables it."""
    checkpoint_minutes: NotNegative = 10.0
    """Writes a checkpoint after this many minutes without one; 0 ignores the clock."""
    keep_checkpoints: PositiveInt = 3
    """Number of latest checkpoints to keep, in addition to the best one."""
    wandb_project: str | None = None
    """Logs to this project of Weights & Biases; None disables it."""
    progress: bool = field(default_factory=lambda: bool(getattr(sys.stderr, "isatty", bool)()))
    """Shows a progress bar; default: only if stderr is a terminal."""

    def __post_init__(self) -> None:
        if not isinstance(self.output_dir, str | os.PathLike) or not str(self.output_dir):
            raise ValueError(f"output_dir must be a folder's path, got {self.output_dir!r}.")
        object.__setattr__(self, "output_dir", str(in_home(self.output_dir)))
        check_choice("resume", self.resume, ("never", "latest"))
        check_annotated(self)
        if self.seed + self.seeds > 2**32:
            raise ValueError(
                f"seeds must be below 2**32, got seed={self.seed} and seeds={self.seeds}."
            )


def describe_run(
    algorithm: Algorithm, options: RunConfig, clips: Sequence[str] = ()
) -> dict[str, Any]:
    """Return all that affects the result of a run as JSON values; ``clips`` are digests."""
    settings = describe(algorithm.config) | {name: getattr(options, name) for name in OF_RUNS}
    settings["clips"] = place_of(settings["clips"])
    # Processors may render single pixels of procedural clips differently.
    made = settings["clips"] in (None, "procedural")
    return {
        "algorithm": algorithm.name,
        "config": settings,
        "clips": None if made else list(clips) or None,
    }


def former_settings(kind: type[TrainConfig]) -> dict[str, Any]:
    """Return values by name for settings of class ``kind`` that a stored run lacks."""
    return describe(kind()) | {name: getattr(RunConfig(), name) for name in OF_RUNS}


def versions() -> dict[str, str]:
    """Return the versions of packages, the processor, and number and kind of devices."""
    found = {
        "devices": f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        "processor": name_cpu(),
    }
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def unknown_settings(about: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """Return a sentence about stored settings that are not ``known`` here, or an empty string."""
    names = [name for name in about["config"] if name not in known and name not in _GONE]
    if not names:
        return ""
    written = about.get("versions", {}).get("pixelbrax", "another release")
    those = ", ".join(f"{name}={about['config'][name]!r}" for name in names)
    return (
        f"This release does not know {those}: the run was written by pixelbrax {written}; use "
        "that release or a later one. "
    )


def differences(about: Mapping[str, Any], own: Mapping[str, Any]) -> list[str]:
    """List what prevents a run ``own`` from continuing ``about``, both from ``describe_run``."""
    old, new = about["config"], own["config"]
    ignored = _GONE | {"memory_budget_gb", "clips"}
    if not new.get("anneal"):
        ignored |= {"total_steps"}
    found = []
    for name in sorted((old.keys() | new.keys()) - ignored):
        if name not in new:
            found.append(f"{name}: {old[name]!r} there, unknown here")
        elif old.get(name) != new[name]:
            found.append(f"{name}: {old.get(name)!r} there, {new[name]!r} here")
    there, here = (place_of(settings.get("clips")) or "procedural" for settings in (old, new))
    if about.get("clips") and own.get("clips"):
        if about["clips"] != own["clips"]:
            found.append(f"clips: those of {there!r} there, different ones in {here!r} here")
    elif there != here:
        named = there == "procedural" or about.get("clips")
        why = "" if named else " (the run has no digest of its clips, so the folder must be equal)"
        found.append(f"clips: {there!r} there, {here!r} here{why}")
    return found


def clip_digests(clips: Clips | None) -> list[str]:
    """Return a hash of the size and content of each clip."""
    if clips is None:
        return []
    pixels, *parts = jax.device_get((clips.packed, clips.first, clips.length))
    frames = [pixels[first : first + length] for first, length in zip(*parts, strict=True)]
    contents = [repr(clip.shape).encode() + clip.tobytes() for clip in frames]
    return [hashlib.sha256(content).hexdigest()[:32] for content in contents]


def place_of(clips: str | None) -> str | None:
    """Return the absolute path of a clips folder; other values stay."""
    if clips is None or clips == "procedural":
        return clips
    return str(whole_path(clips))
