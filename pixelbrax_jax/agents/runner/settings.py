"""Settings of a run as they are stored, and those of a stored run beside the ones of today."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields
from importlib import metadata
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, describe
from pixelbrax_jax.agents.runner.run_config import RunConfig
from pixelbrax_jax.cache import whole_path
from pixelbrax_jax.config import ENV_OPTIONS
from pixelbrax_jax.types import Clips

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


def settings_of(algorithm: Algorithm, options: RunConfig) -> dict[str, Any]:
    """Return what decides the result of a run, as JSON has it; a folder of clips from the root."""
    settings = describe(algorithm.config) | {name: getattr(options, name) for name in OF_RUNS}
    return settings | {"clips": place_of(settings["clips"])}


def former_settings(kind: type[TrainConfig]) -> dict[str, Any]:
    """Return the values that settings had in a stored run that lacks them, by name.

    Args:
        kind: the class of the run's settings.
    """
    defaults = {field.name: field.default for field in (*fields(kind), *fields(RunConfig))}
    names = {*ENV_OPTIONS, *(field.name for field in fields(kind)), *OF_RUNS} - {"env"}
    known = vars(defaults["env"]) | defaults | FORMER_DEFAULTS
    plain = {n: list(v) if isinstance(v, tuple) else v for n, v in known.items() if n in names}
    return {name: value for name, value in plain.items() if value is not MISSING}


def versions() -> dict[str, str]:
    """Return versions of packages, and number and kind of devices."""
    kind = jax.devices()[0].device_kind
    found = {"devices": f"{jax.device_count()} x {kind}"}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def unknown_settings(about: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """Return a sentence on stored settings that this release lacks; empty if it has all of them.

    Args:
        about: what is stored beside a checkpoint.
        known: all settings of this release.
    """
    names = [name for name in about["config"] if name not in known]
    if not names:
        return ""
    written = about.get("versions", {}).get("pixelbrax", "another release")
    those = ", ".join(f"{name}={about['config'][name]!r}" for name in names)
    return (
        f"This release does not know {those}: the run was written by pixelbrax {written}; take "
        "that release or a later one. "
    )


def differences(about: Mapping[str, Any], own: Mapping[str, Any]) -> list[str]:
    """Return the settings with which a run may not go on, one line each.

    Args:
        about: what is stored beside the checkpoint, with all settings.
        own: the same of the run that shall go on.
    """
    old, new = about["config"], own["config"]
    free = {name for name in _FREE if name != "total_steps" or not new.get("anneal")}
    found = [
        f"{name}: {old.get(name)!r} there, {new[name]!r} here"
        if name in new
        else f"{name}: {old[name]!r} there, unknown here"
        for name in sorted((old.keys() | new.keys()) - free - _GONE - {"clips"})
        if name not in new or old.get(name) != new[name]
    ]
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
    return [_digest(pixels[first : first + length]) for first, length in zip(*parts, strict=True)]


def stored_clips(config: TrainConfig, digests: Sequence[str]) -> Sequence[str] | None:
    """Return what is stored of a run's clips; None of those that are made, which their name tells.

    Made ones may differ in a pixel from one processor to the next.

    Args:
        config: of the run.
        digests: of its clips.
    """
    made = config.env.clips is None or config.env.clips == "procedural"
    return None if made else digests or None


def shared_clips(some: Sequence[str], others: Sequence[str]) -> int:
    """Return how many of some clips, by their digests, are among others."""
    return sum(digest in others for digest in some)


def _digest(frames: np.ndarray) -> str:
    digest = hashlib.sha256(repr(frames.shape).encode())
    digest.update(np.ascontiguousarray(frames).data)
    return digest.hexdigest()[:32]


def place_of(clips: str | None) -> str | None:
    """Return where clips are, whatever the current folder will be."""
    if clips is None or clips == "procedural":
        return clips
    return str(whole_path(clips))
