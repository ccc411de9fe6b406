"""Environments to evaluate in: without distractors, with those of the training, with new clips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.runner.progress import Report, silent
from pixelbrax_jax.agents.runner.settings import clip_digests
from pixelbrax_jax.cache import whole_path
from pixelbrax_jax.distractors import folders, procedural
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_choice

SPLITS = ("clean", "train", "test")

HELD_OUT = {"train": "test", "paper-train": "paper-test"}
"""Split of the clips that training plays -> the one kept for tests. Of another split the test
plays the same one, of another folder."""

WITHOUT_DISTRACTORS: dict[str, Any] = {"distractors": (), "clips": None, "split": "train"}
"""Options of an environment that shows none, whatever its other options are."""


class NoSplitError(ValueError):
    """A split is not there, or would not be what its name says."""


def splits_of(config: TrainConfig) -> tuple[str, ...]:
    """Return names of the splits that there may be."""
    env = config.env
    if not env.distractors:
        return SPLITS[:1]
    plays = any(isinstance(link, Video) for link in resolve(env.distractors, env.task))
    return SPLITS if plays else SPLITS[:2]


def make_splits(
    config: TrainConfig,
    names: Sequence[str] = (),
    *,
    shown: Sequence[str] | None = None,
    report: Report = silent,
) -> Iterator[tuple[str, tuple[PixelEnv, EnvParams]]]:
    """Yield environments to evaluate in: the name of the split, the environment, its parameters.

    ``clean`` has no distractors, ``train`` those of the training, and ``test`` the same with clips
    that training never shows: those of the split ``test``, or ``paper-test`` where training plays
    ``paper-train``. Without distractors there is only ``clean``, and without a video no ``test``.

    Args:
        config: of the training, or with other clips.
        names: of the splits, all of which must be there; without any, those that are there.
        shown: digests of the clips that training plays, as of ``clip_digests``; None takes those
            that ``config`` names.
        report: gets a line about a split that is left out.

    Raises:
        ValueError, FileNotFoundError: as `make_split`.
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
    """Return one of the environments of `make_splits`.

    Raises:
        NoSplitError: ``train`` would not show the clips of the training, or ``test`` would show
            some of them, or there are no clips for it.
        ValueError: there is no such split.
        FileNotFoundError: the folder of the clips is missing.
    """
    check_choice("split", name, SPLITS)
    names = splits_of(config)
    if name not in names:
        has_any = bool(config.env.distractors)
        lacks = "clips, and the run played" if has_any else "distractors, and the run had"
        raise ValueError(
            f"split {name!r} is for {lacks} none; there is only {' and '.join(map(repr, names))}."
        )
    if name == "clean":
        return _make(config, **WITHOUT_DISTRACTORS)
    if name == "train":
        env, params = _make(config)
        if shown and clip_digests(params.clips) != list(shown):
            raise NoSplitError(
                f"the clips of split {config.env.split!r} of {_source(config)} are not those of "
                "the training."
            )
        return env, params
    split = HELD_OUT.get(config.env.split, config.env.split)
    _check_there(config, split)
    shown = shown or clip_digests(_make(config)[1].clips)
    env, params = _make(config, split=split)
    played = clip_digests(params.clips)
    if shared := sum(digest in shown for digest in played):
        raise NoSplitError(
            f"of the {len(played)} clips of split {split!r} of {_source(config)}, training plays "
            f"{shared}; --clips takes others."
        )
    return env, params


def _make(config: TrainConfig, **changes: Any) -> tuple[PixelEnv, EnvParams]:
    try:
        # What training sees of the state, evaluation need not.
        return make_env(config, obs_mode="pixels", **changes)
    except FileNotFoundError as error:
        if _source(config) == "procedural":
            raise
        raise FileNotFoundError(
            "the clips of the run are not there; if they are elsewhere, name their folder with "
            f"--clips: {error}"
        ) from error


def _check_there(config: TrainConfig, split: str) -> None:
    """Raise a NoSplitError that lists the splits of the clips, if this one is not among them."""
    try:
        if _source(config) == "procedural":
            check_choice("split of procedural clips", split, procedural.SPLITS)
        else:
            folders.find(whole_path(_source(config)), split)
    except (ValueError, FileNotFoundError) as error:
        raise NoSplitError(str(error)) from error


def _source(config: TrainConfig) -> str:
    return str(config.env.clips or "procedural")
