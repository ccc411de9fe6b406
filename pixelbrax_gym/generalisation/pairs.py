"""Record the same episodes clean and under a level, as a dataset of Minari."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import metadata
from os import PathLike
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from pixelbrax_gym.generalisation.evaluation import (
    Policy,
    begin,
    checked,
    make_level_envs,
    numpy_of,
)
from pixelbrax_gym.generalisation.scores import LEFT_OUT, options_of
from pixelbrax_jax import VectorPixelEnv
from pixelbrax_jax.config import env_config
from pixelbrax_jax.extras import needs_extra
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.generalisation.making import UNDISTURBED, Levels, make_levels
from pixelbrax_jax.generalisation.suites import EPISODES, SUITES
from pixelbrax_jax.paths import make_folder
from pixelbrax_jax.validation import check_choice, check_positive_int

VIEWS = ("clean", "level")
IMAGES = ("depth", "segmentation")

_ABOUT, _KEPT = "metadata.json", ".kept"
"""Minari's file about the dataset or an episode, and the suffix of the former's copy."""

_SETTINGS = "pixelbrax"
"""Key of the recording's settings in the metadata."""


def record_pairs(
    policy: Policy | None,
    task: str,
    suite: str,
    level: str,
    output_dir: str | PathLike[str],
    *,
    episodes: int | None = None,
    clips: str | PathLike[str] | None = None,
    images: Sequence[str] = (),
    sees: str = "clean",
    policy_name: str = "policy",
    num_envs: int = 8,
    output: str = "numpy",
    report: Callable[[str], object] = lambda _: None,
    **options: Any,
) -> Path:
    """Record episodes that differ only in their images: clean, and under a level of a suite.

    Episode i is that of ``evaluate_suite``. The dataset is Minari's, lossless, with a Parquet file
    for each episode: ``minari.MinariDataset(path)`` reads it, and so does everything that reads
    Parquet. An observation is a dictionary, of one frame each:

    * ``pixels`` and ``pixels_level``: (H, W, 3 C) uint8, clean and under the level, C cameras;
    * ``depth`` (H, W, C) float32, metres, and ``segmentation`` (H, W, C) int32, row of the geom or
      -1, of the clean image, if in ``images``;
    * ``state``: (S,) float32, the task's observation of the state.

    Actions are (A,) float32, clipped to [-1, 1] as the environment does. Numbers that are the same
    in both, such as rewards, are stored once.

    Args:
        policy: as in ``evaluate_suite``; None samples actions uniformly.
        task: one of ``pixelbrax_jax.list_envs()``.
        suite: a suite that has the level.
        level: name of the level.
        output_dir: folder of the dataset. If it has episodes of the same recording already, the
            others follow.
        episodes: number E of episodes; None for the suite's.
        clips: folder of the videos, or ``"procedural"``, for levels that show any.
        images: any of ``depth`` and ``segmentation``.
        sees: which images the policy sees, ``clean`` or ``level``.
        policy_name: name of the policy in the dataset; another policy needs another name or folder.
        num_envs: number of episodes that are played, and held in memory, together.
        output: type of the policy's observations, ``"numpy"``, ``"torch"`` or ``"jax"``.
        report: takes lines about the size and progress.
        **options: other options of ``pixelbrax_jax.make``, such as ``action_repeat``.

    Returns:
        The folder.

    Raises:
        ValueError: a name or number is not allowed, the policy returns another shape or NaN, or
            the folder has something else or is a file.
        FileNotFoundError: clips are missing; the message says where to get them.
        TypeError: an option is unknown, the suite's own or ``obs_mode``.
        ImportError: Minari is missing; the message says how to install it.
        RuntimeError: rewards or ends under the level are not those of the clean episode.
    """
    images = (images,) if isinstance(images, str) else tuple(images)
    if policy is not None and not callable(policy):
        raise TypeError(f"policy must be a function of observations or None, got {policy!r}.")
    check_choice("suite", suite, SUITES)
    check_choice("sees", sees, VIEWS)
    for name in images:
        check_choice("images", name, IMAGES)
    if own := [name for name in (*LEFT_OUT, "obs_mode") if name in options]:
        raise TypeError(f"{own[0]} is decided by the recording; leave it out.")
    reserved = ("output_dir", "episodes", "clips", "images", "sees", "policy_name", "num_envs")
    config = env_config(task, options, (*reserved, "output", "report"))
    if config.camera_sizes:
        raise ValueError("camera_sizes cannot be recorded: leave them out; use height and width.")
    levels = make_levels(config, suite, episodes, clips, report, only=level)
    episodes = levels.episodes
    num_envs = min(check_positive_int("num_envs", num_envs), episodes)
    pairs = _Pairs(levels, images, num_envs, output)
    settings = options_of(levels) | {
        "task": levels.config.task,
        "suite": suite,
        "level": level,
        "images": list(images),
        "sees": sees,
        "policy": "uniform" if policy is None else policy_name,
    }
    folder = make_folder("output_dir", output_dir)
    # Minari joins a relative folder to itself.
    storage = _storage(folder.absolute(), pairs, settings)
    first = storage.total_episodes
    size = pairs.bytes_per_episode * (episodes - first) / 1e9
    report(f"{episodes - first} episodes, at most {size:.2f} GB before compression")
    about = storage.data_path / _ABOUT
    while first < episodes:
        for number in range(first, min(first + num_envs, episodes)):
            # The episode is incomplete if a recording was stopped while writing it.
            (storage.data_path / str(number) / _ABOUT).unlink(missing_ok=True)
        storage.update_episodes(pairs.play(first, policy, sees))
        first = storage.total_episodes
        shutil.copyfile(about, about.with_suffix(_KEPT))
        report(f"{first} of {episodes} episodes")
    return folder


class _Pairs:
    """The environments of both views, stepped by the same actions; ``spaces`` are of one frame."""

    def __init__(self, levels: Levels, images: tuple[str, ...], num_envs: int, output: str) -> None:
        (self._one,) = levels.levels
        self._levels, self._num_envs = levels, num_envs
        make = partial(make_level_envs, levels, self._one, num_envs, output)
        clean = make(**UNDISTURBED, obs_mode="+".join(("pixels", *images, "state")))
        self._envs = {"clean": clean, "level": make()}
        stacks: Any = clean.single_observation_space
        stacks = {**stacks.spaces, "pixels_level": self._envs["level"].single_observation_space}
        frames = {n: 1 if n == "state" else levels.config.frame_stack for n in stacks}
        self.spaces = {n: _one_frame(space, frames[n]) for n, space in stacks.items()}
        self.action_space: Any = clean.single_action_space
        self._num_steps = clean._stateful.max_episode_steps

    @property
    def bytes_per_episode(self) -> int:
        parts = [np.zeros(x.shape, x.dtype).nbytes for x in self.spaces.values()]
        return (self._num_steps + 1) * sum(parts)

    def play(self, first: int, policy: Policy | None, sees: str) -> Iterator[Any]:
        """Play episodes from ``first`` on; yield Minari's buffers."""
        from minari.data_collector import EpisodeBuffer

        index = np.arange(first, min(first + self._num_envs, self._levels.episodes))
        obs = self._reset(np.resize(index, self._num_envs))
        random = [np.random.default_rng([EPISODES, int(number)]) for number in index]
        shape = (self._num_envs, *self.action_space.shape)
        frames, length = [self._frames(obs)], np.zeros(self._num_envs, int)
        steps: list[tuple[np.ndarray, ...]] = []
        over = np.zeros(self._num_envs, bool)
        while not over.all():
            if policy is None:
                drawn = [one.uniform(-1.0, 1.0, shape[1:]) for one in random]
                actions: Any = np.resize(np.array(drawn, np.float32), shape)
            else:
                seen = obs[sees]["pixels"] if sees == "clean" else obs[sees]
                actions = checked(policy(seen), shape, np.resize(index, shape[0]))
            length += ~over
            stepped = {name: envs.step(actions) for name, envs in self._envs.items()}
            obs = {name: result[0] for name, result in stepped.items()}
            frames.append(self._frames(obs))
            rewards, terminated, truncated = (numpy_of(x) for x in stepped["clean"][1:4])
            for one, other in zip(stepped["clean"][1:4], stepped["level"][1:4], strict=True):
                if not np.allclose(numpy_of(one)[~over], numpy_of(other)[~over], 1e-3, 1e-3):
                    raise RuntimeError(
                        f"the episodes part in step {len(steps)} of episodes {index[0]} to "
                        f"{index[-1]}: the simulation is not the same in both programs. Please "
                        "report it with the output of `pixelbrax doctor`."
                    )
            played = np.clip(numpy_of(actions).astype(np.float32), -1.0, 1.0)
            steps.append((played, rewards, terminated, truncated))
            over |= terminated | truncated
        for row, episode in enumerate(index):
            end = int(length[row])
            actions, *numbers = (
                np.stack([step[part][row] for step in steps[:end]]) for part in range(4)
            )
            yield EpisodeBuffer(
                id=int(episode),
                observations={
                    name: np.stack([frame[name][row] for frame in frames[: end + 1]])
                    for name in self.spaces
                },
                actions=actions,
                rewards=numbers[0],
                terminations=numbers[1],
                truncations=numbers[2],
            )

    def _reset(self, index: np.ndarray) -> dict[str, Any]:
        """Start the episodes with these numbers; return both observations."""
        with default_flags():
            keys = VectorPixelEnv.env_keys(jax.random.key(EPISODES), self._levels.episodes)[index]
        clean, level = self._envs.values()
        params = self._levels.params_of(self._one, index)
        return {
            "clean": begin(clean, keys, clean._stateful.params),
            "level": begin(level, keys, params),
        }

    def _frames(self, obs: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the newest frame of each image, and the state."""
        parts = {**obs["clean"], "pixels_level": obs["level"]}
        sizes = {name: space.shape[-1] for name, space in self.spaces.items()}
        return {name: numpy_of(x)[..., -sizes[name] :].copy() for name, x in parts.items()}


def _one_frame(space: Any, frames: int) -> Any:
    """Return the part of a space that belongs to the newest of several frames."""
    channels = slice(space.shape[-1] - space.shape[-1] // frames, None)
    return gym.spaces.Box(space.low[..., channels], space.high[..., channels], dtype=space.dtype)


def _storage(folder: Path, pairs: _Pairs, settings: dict[str, Any]) -> Any:
    """Return Minari's storage of the folder, with the episodes that it has."""
    with needs_extra("dataset"):
        import minari.dataset._storages.arrow_storage  # noqa: F401  # it needs pyarrow
        from minari.dataset.minari_storage import MinariStorage
    settings = json.loads(json.dumps(settings, default=str))
    about = folder / _ABOUT
    if about.exists():
        try:
            raw = MinariStorage.read_raw_metadata(folder)
        except json.JSONDecodeError as error:
            # A recording was stopped while writing it.
            if not about.with_suffix(_KEPT).exists():
                raise ValueError(f"{about} is damaged ({error}); delete the folder.") from error
            shutil.copyfile(about.with_suffix(_KEPT), about)
            raw = MinariStorage.read_raw_metadata(folder)
        if not isinstance(raw, dict):
            raise ValueError(f"{about} is not of a recording; take another folder.")
        found = raw.get(_SETTINGS)
        is_begun = "dataset_id" not in raw and {"total_episodes", "action_space"} <= raw.keys()
        if is_begun and raw["total_episodes"] == 0 and list(folder.iterdir()) == [about]:
            # Minari's initial file: the recording stopped before it stored its settings.
            about.unlink()
            return _new_storage(folder, pairs, settings)
        if found != settings:
            found = found if isinstance(found, dict) else {}
            names = [n for n in {**settings, **found} if settings.get(n) != found.get(n)]
            differ = "; ".join(f"{n}={found.get(n)!r}, not {settings.get(n)!r}" for n in names)
            raise ValueError(f"{folder} has another recording: {differ}. Take another folder.")
        return MinariStorage.read(folder)
    if any(folder.iterdir()):
        raise ValueError(f"{folder} has files, but no recording; take another folder.")
    return _new_storage(folder, pairs, settings)


def _new_storage(folder: Path, pairs: _Pairs, settings: dict[str, Any]) -> Any:
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.new(
        folder,
        gym.spaces.Dict(pairs.spaces),
        pairs.action_space,
        data_format="parquet",
        jpeg_encoding=False,
    )
    # Minari's ids have no dots.
    name = re.sub(r"[^-\w]", "-", "-".join(settings[n] for n in ("task", "suite", "level")))
    storage.update_metadata(
        {
            "dataset_id": f"pixelbrax/{name}-v0",
            "algorithm_name": settings["policy"],
            "minari_version": metadata.version("minari"),
            "description": f"Episodes of {settings['task']}, clean and under level "
            f"{settings['level']} of suite {settings['suite']}, recorded by PixelBrax.",
            _SETTINGS: settings,
        }
    )
    return storage
