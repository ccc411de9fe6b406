"""Evaluation environments: without distractors, with those of the training, with new clips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.runner.progress import Report, silent
from pixelbrax_jax.agents.runner.settings import clip_digests
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.generalisation.making import UNDISTURBED
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_choice

SPLITS = ("clean", "train", "test")

HELD_OUT = {"train": "test", "paper-train": "paper-test"}
"""Test split of each training split; others serve for both, with test clips of another folder."""


class NoSplitError(ValueError):
    """A split is missing, or its clips do not fit its name."""


def splits_of(config: TrainConfig) -> tuple[str, ...]:
    """Return the names of the splits that fit the settings."""
    env = config.env
    if not (env.distractors or env.dynamics or config.test_dynamics):
        return SPLITS[:1]
    return SPLITS if plays_clips(config) or config.test_dynamics else SPLITS[:2]


def plays_clips(config: TrainConfig) -> bool:
    """Return whether the settings have a video distractor."""
    env = config.env
    return any(isinstance(link, Video) for link in resolve(env.distractors, env.task))


def make_splits(
    config: TrainConfig,
    names: Sequence[str] = (),
    *,
    shown: Sequence[str] | None = None,
    report: Report = silent,
) -> Iterator[tuple[str, tuple[PixelEnv, EnvParams]]]:
    """Yield name, environment and parameters of each split.

    ``clean`` has neither distractors nor varied dynamics. ``train`` has those of the training.
    ``test`` has the same distractors with other clips (split ``test``, or ``paper-test`` if
    training uses ``paper-train``) and ``test_dynamics``; it needs at least one of these.

    Without ``names`` it yields all available splits and reports the missing ones. ``shown`` are
    ``clip_digests`` of the training's clips; None uses the clips of ``config``.
    """
    for name in names or splits_of(config):
        try:
            made = make_split(config, name, shown)
        except NoSplitError as error:
            if names:
                raise
            report(f"no split {name!r}: {error}")
        else:
            yield name, made


def make_split(
    config: TrainConfig, name: str, shown: Sequence[str] | None = None
) -> tuple[PixelEnv, EnvParams]:
    """Make one of the environments of `make_splits`.

    Raises:
        NoSplitError: ``train`` has other clips than training, or ``test`` has none or shared ones.
    """
    check_choice("split", name, SPLITS)
    names = splits_of(config)
    if name not in names:
        lacks = "clips or test_dynamics" if len(names) > 1 else "distractors or dynamics"
        raise ValueError(
            f"split {name!r} needs {lacks}, but the run has none; its splits: "
            f"{', '.join(map(repr, names))}."
        )
    if name == "clean":
        return _make(config, **UNDISTURBED)
    if name == "train":
        env, params = _make(config)
        if shown and clip_digests(params.clips) != list(shown):
            raise NoSplitError(
                f"the clips of split {config.env.split!r} of {_source(config)} differ from those "
                "of the training."
            )
        return env, params
    plays, split = plays_clips(config), config.env.split
    split = HELD_OUT.get(split, split) if plays else split
    dynamics = config.test_dynamics or config.env.dynamics
    try:
        mode = config.env.obs_mode
        env, params = make_env(config, obs_mode=mode, split=split, dynamics=dynamics)
    except (ValueError, FileNotFoundError) as error:
        raise NoSplitError(str(error)) from error
    if not plays:
        return env, params
    shown = shown or clip_digests(_make(config)[1].clips)
    played = clip_digests(params.clips)
    if shared := sum(digest in shown for digest in played):
        raise NoSplitError(
            f"training uses {shared} of the {len(played)} clips of split {split!r} of "
            f"{_source(config)}; choose other clips with --clips."
        )
    return env, params


def _make(config: TrainConfig, **changes: Any) -> tuple[PixelEnv, EnvParams]:
    try:
        # Evaluation does not need the simulator's state.
        return make_env(config, obs_mode=config.env.obs_mode, **changes)
    except FileNotFoundError as error:
        if _source(config) == "procedural":
            raise
        raise FileNotFoundError(
            f"the clips of the run are missing; set their folder with --clips: {error}"
        ) from error


def _source(config: TrainConfig) -> str:
    return str(config.env.clips or "procedural")
