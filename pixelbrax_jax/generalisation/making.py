"""Environments and parameters of a suite's levels, which share programs where they can."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from os import PathLike
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.distractors.base import Chain, Distractor
from pixelbrax_jax.distractors.clips import ClipBank, load_clips
from pixelbrax_jax.distractors.procedural import SPLITS
from pixelbrax_jax.envs.making import make
from pixelbrax_jax.envs.param_rows import split_params
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.generalisation.changes import Change, changes_params_alone
from pixelbrax_jax.generalisation.suites import EPISODES, SUITES, Level, levels_of
from pixelbrax_jax.observations import parts_of
from pixelbrax_jax.paths import whole_path
from pixelbrax_jax.registry import find_task
from pixelbrax_jax.scene.cameras import seen_from
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_choice, check_positive_int

UNDISTURBED: dict[str, Any] = {"distractors": (), "clips": None, "split": "train", "dynamics": ""}
"""Options without distractors and without varied dynamics; a suite decides them."""

_EPISODE = 2**32 - 1
"""Index of the episode whose keys draw the levels' parameters; no training reaches it."""

_WHERE = (
    "DMControl-GB's are the folders video_easy and video_hard in src/env/data of "
    "https://github.com/nicklashansen/dmcontrol-generalization-benchmark; DAVIS-2017 at 480p is at "
    "https://davischallenge.org/davis2017/code.html. Give the folder of DAVIS, or one folder with "
    "video_easy, video_hard and DAVIS in it. clips='procedural' needs no files, but its results "
    "are comparable only with its own"
)


@dataclass(frozen=True, eq=False)
class LevelEnv:
    """One level, ready to be played.

    ``env`` has the distractors that act within episodes; ``params`` may have rows for each episode.
    """

    level: Level
    env: PixelEnv
    params: EnvParams


@dataclass(frozen=True, eq=False)
class Levels:
    """The levels of a suite, ready to be played, and the clips that they show.

    Attributes:
        config: the task and the options, without distractors and clips of its own.
        suite: name of the suite.
        levels: in the order of the suite.
        episodes: number E of episodes, rows of the parameters.
        bank: the clips of all levels; None without any.
        splits: range of the clips of each split in the bank.
    """

    config: EnvConfig
    suite: str
    levels: tuple[LevelEnv, ...]
    episodes: int
    bank: ClipBank | None
    splits: dict[str, range]

    @property
    def num_programs(self) -> int:
        """Number of different programs."""
        flat = [(one.env, *jax.tree.flatten(one.params)) for one in self.levels]
        return len({(env, tree, *map(np.shape, leaves)) for env, leaves, tree in flat})

    def params_of(self, level: LevelEnv, index: Any) -> EnvParams:
        """Return the parameters of an episode, or of those with numbers (M,), a row for each."""
        rows = split_params(level.params, self.episodes)
        return rows.join([own[index] for own in rows.own])


@default_flags()
def make_levels(
    config: EnvConfig,
    suite: str,
    episodes: int | None = None,
    clips: str | PathLike[str] | None = None,
    report: Callable[[str], object] = lambda _: None,
    only: str | None = None,
) -> Levels:
    """Make the levels of a suite for a task with these options, or ``only`` the one of this name.

    Distractors, clips, split and dynamics of ``config`` are ignored. Episode i of every level
    starts from the same state, that of the key ``fold_in(key(EPISODES), i)``. A level draws its
    parameters with a key that no training uses. ``clips`` is a folder or ``procedural``;
    ``report`` takes lines about replaced clips. ``only`` does not change the level.
    """
    if "pixels" not in parts_of(config.obs_mode):
        raise ValueError(
            f"a suite changes colors, but obs_mode={config.obs_mode!r} shows none; add pixels."
        )
    config = replace(config, **UNDISTURBED)
    levels = levels_of(suite, find_task(config.task))
    episodes = SUITES[suite].episodes if episodes is None else episodes
    episodes = check_positive_int("episodes", episodes)
    if only is not None:
        check_choice("level", only, [level.name for level in levels])
        levels = tuple(level for level in levels if level.name == only)
    what = f"suite {suite!r}" if only is None else f"level {only!r} of suite {suite!r}"
    bank, splits = _bank(config, what, levels, clips, report)
    made = [_make(config, level, bank) for level in levels]
    keys = VectorPixelEnv.env_keys(jax.random.key(EPISODES), episodes)
    keys = jax.vmap(lambda key: jax.random.fold_in(key, _EPISODE))(keys)
    drawn = []
    for level, (_, base) in zip(levels, made, strict=True):
        try:
            drawn.append(_draw(level.changes, base.replace(clips=None), keys))
        except ValueError as error:
            raise ValueError(
                f"level {level.name!r} of suite {suite!r} cannot be made for task "
                f"{config.task!r}: {error}"
            ) from error
    params = _share([base.replace(clips=None) for _, base in made], drawn, episodes)
    ready = []
    for level, (env, base), of_level in zip(levels, made, params, strict=True):
        if base.clips is not None:
            split = next(name for name in level.clips if name in splits)
            shown = list(splits[split])[: level.num_clips]
            of_level = of_level.replace(clips=_show(base.clips, shown, level.in_order, keys))
        ready.append(LevelEnv(level, env, jax.device_put(of_level)))
    return Levels(config, suite, tuple(ready), episodes, bank, splits)


def _make(config: EnvConfig, level: Level, bank: ClipBank | None) -> tuple[PixelEnv, EnvParams]:
    links = [link for link in level.changes if isinstance(link, Distractor)]
    own = tuple(link for link in links if not changes_params_alone(link))
    shown = {"distractors": own, "clips": bank if level.clips else None}
    env, base = make(config, **shown)
    replace(env, distractors=tuple(links))  # raises an error for one that does not fit
    return env, base


def _draw(changes: Sequence[Change | Distractor], base: EnvParams, keys: jax.Array) -> EnvParams:
    """Return parameters in which changed arrays have a row for each episode."""
    chosen = [
        change for change in changes if isinstance(change, Change) or changes_params_alone(change)
    ]
    before, tree = jax.tree.flatten(base)

    def of_episode(key: jax.Array, episode: jax.Array) -> list[Any]:
        def step(params: EnvParams, change: Change | Distractor) -> EnvParams:
            if isinstance(change, Change):
                own = jax.random.fold_in(key, chosen.index(change))
                return change.change(params, own, episode)
            return change.change_params(change.reset(Chain.key(key, change, 0), params), params)

        after = jax.tree.leaves(reduce(step, chosen, base))
        return [None if new is old else new for new, old in zip(after, before, strict=True)]

    drawn = jax.vmap(of_episode)(keys, jnp.arange(len(keys)))
    leaves = [old if new is None else new for new, old in zip(drawn, before, strict=True)]
    rows: EnvParams = jax.tree.unflatten(tree, leaves)
    if np.ndim(rows.geoms.size) > np.ndim(base.geoms.size):
        smallest = base.geoms.replace(size=np.asarray(rows.geoms.size).min(0))
        cameras = base.rig if isinstance(base.rig, tuple) else (base.rig,)
        distant = seen_from(smallest, *cameras).distant
        rows = rows.replace(geoms=rows.geoms.replace(distant=distant))
    return rows


def _share(
    bases: Sequence[EnvParams], drawn: Sequence[EnvParams], episodes: int
) -> list[EnvParams]:
    """Give an array a row per episode in all levels if any level changes it."""
    before = [jax.tree.leaves(base) for base in bases]
    after = [jax.tree.leaves(rows) for rows in drawn]
    changed = [
        any(
            np.ndim(rows[i]) > np.ndim(base[i]) and bool(np.any(rows[i] != base[i]))
            for base, rows in zip(before, after, strict=True)
        )
        for i in range(len(before[0]))
    ]

    def shared(base: Any, row: Any, own: bool) -> Any:
        if not own or np.ndim(row) > np.ndim(base):
            return row if own else base
        return np.repeat(np.asarray(base)[None], episodes, axis=0)

    found = []
    for rows, old, new in zip(drawn, before, after, strict=True):
        leaves = [shared(*parts) for parts in zip(old, new, changed, strict=True)]
        found.append(jax.tree.unflatten(jax.tree.structure(rows), leaves))
    return found


def _show(clips: Any, shown: Sequence[int], in_order: bool, keys: jax.Array) -> Any:
    """Return the clips with a row of one clip for each episode."""
    episodes = np.arange(len(keys)) % len(shown)
    if not in_order:
        draw = jax.vmap(lambda key: jax.random.randint(key, (), 0, len(shown)))
        episodes = np.asarray(draw(keys))
    clip = np.asarray(shown)[episodes][:, None]
    first, length = np.asarray(clips.first)[clip], np.asarray(clips.length)[clip]
    return clips.replace(first=jnp.asarray(first), length=jnp.asarray(length))


def _bank(
    config: EnvConfig,
    what: str,
    levels: Sequence[Level],
    clips: str | PathLike[str] | None,
    report: Callable[[str], object],
) -> tuple[ClipBank | None, dict[str, range]]:
    """Return the clips of all levels in one bank, and the range of each split."""
    wanted = dict.fromkeys(level.clips for level in levels if level.clips)
    if not wanted:
        if clips is not None:
            raise ValueError(f"{what} shows no video; leave out clips={str(clips)!r}.")
        return None, {}
    if clips is None:
        raise FileNotFoundError(f"{what} shows videos: give their folder. {_WHERE}.")
    banks: dict[str, ClipBank] = {}
    for names in wanted:
        split, bank = _first_split(clips, names, config)
        if split != names[0]:
            report(f"clips of split {split!r} of {clips} are shown for {names[0]!r}")
        banks[split] = bank
    ends = np.cumsum([len(bank.names) for bank in banks.values()])
    splits = {
        name: range(int(end) - len(bank.names), int(end))
        for (name, bank), end in zip(banks.items(), ends, strict=True)
    }
    joined = ClipBank(
        frames=np.concatenate([bank.frames for bank in banks.values()]),
        length=np.concatenate([bank.length for bank in banks.values()]),
        names=tuple(name for bank in banks.values() for name in bank.names),
        source=str(clips),
        split="train",
    )
    return joined, splits


def _first_split(
    clips: str | PathLike[str], names: Sequence[str], config: EnvConfig
) -> tuple[str, ClipBank]:
    """Return the first split of ``names`` that exists, and its clips."""
    read = partial(load_clips, height=config.height, width=config.width)
    if str(clips) == "procedural":
        split = next(name for name in names if name in SPLITS)
        return split, read("procedural", split)
    folder = whole_path(clips)
    for name in names:
        if (folder / name).is_dir() and not (folder / "JPEGImages").is_dir():
            return name, read(folder / name, "all")
    errors = []
    for name in names:
        try:
            return name, read(folder, name)
        except (ValueError, FileNotFoundError) as error:
            errors.append(str(error))
    raise FileNotFoundError(f"{errors[-1]} Wanted: {' or '.join(names)}. {_WHERE}.")
