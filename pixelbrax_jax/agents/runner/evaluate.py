"""How good a policy is: fixed episodes, with and without distractors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.optimizer import Networks
from pixelbrax_jax.agents.runner.settings import clip_digests, shared_clips
from pixelbrax_jax.cache import whole_path
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.distractors import folders, procedural
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.types import EnvParams, EnvState
from pixelbrax_jax.validation import check_choice

SPLITS = ("clean", "train", "test")

HELD_OUT = {"train": "test", "paper-train": "paper-test"}
"""Split of the clips that training plays -> the one kept for tests. Of another split the test
plays the same one, of another folder."""

WITHOUT_DISTRACTORS: dict[str, Any] = {"distractors": (), "clips": None, "split": "train"}
"""Options of an environment that shows none, whatever its other options are."""


class Player(Protocol):
    """What chooses actions; hashable. Every ``Algorithm`` does."""

    @property
    def config(self) -> TrainConfig:
        """Settings of its training."""

    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """As ``Algorithm.act``."""


@dataclass(frozen=True)
class Result:
    """Episodes of one policy.

    Attributes:
        returns: (E,) float64, sums of rewards.
        lengths: (E,) int, control steps.
    """

    returns: np.ndarray
    lengths: np.ndarray

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return; NaN of a single episode."""
        if len(self.returns) < 2:
            return float("nan")
        return float(self.returns.std(ddof=1) / np.sqrt(len(self.returns)))


class NoSplitError(ValueError):
    """A split is not there, or would not be what its name says."""


def _silent(line: str) -> None:
    del line


def make_splits(
    config: TrainConfig,
    shown: Sequence[str] | None = None,
    report: Callable[[str], None] = _silent,
) -> dict[str, tuple[PixelEnv, EnvParams]]:
    """Return environments to evaluate in, by name of the split.

    ``clean`` has no distractors, ``train`` those of the training, and ``test`` the same with clips
    that training never shows: those of the split ``test``, or ``paper-test`` where training plays
    ``paper-train``. A split that there is not is left out. Without distractors there is only
    ``clean``, and without a video no ``test``.

    Args:
        config: of the training.
        shown: digests of the clips that training plays, as of ``clip_digests``; None takes those
            that ``config`` names.
        report: gets a line about a split that is left out.
    """
    made = {}
    for name in splits_of(config):
        try:
            made[name] = make_split(config, name, shown)
        except NoSplitError as error:
            report(f"no split {name!r}: {error}")
    return made


def splits_of(config: TrainConfig) -> tuple[str, ...]:
    """Return names of the splits that there may be."""
    if not config.env.distractors:
        return SPLITS[:1]
    plays = any(
        isinstance(link, Video) for link in resolve(config.env.distractors, config.env.task)
    )
    return SPLITS if plays else SPLITS[:2]


def make_split(
    config: TrainConfig, name: str, shown: Sequence[str] | None = None
) -> tuple[PixelEnv, EnvParams]:
    """Return one of the environments of `make_splits`.

    Args:
        config: of the training, or with other clips.
        name: of the split.
        shown: digests of the clips that training plays; None takes those that ``config`` names.

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
    if shared := shared_clips(played, shown):
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
    """Reject a split that the clips have not.

    Raises:
        NoSplitError: saying which there are.
    """
    try:
        if _source(config) == "procedural":
            check_choice("split of procedural clips", split, procedural.SPLITS)
        else:
            folders.find(whole_path(_source(config)), split)
    except (ValueError, FileNotFoundError) as error:
        raise NoSplitError(str(error)) from error


def _source(config: TrainConfig) -> str:
    return str(config.env.clips or "procedural")


class Evaluator:
    """Plays whole episodes, the same ones every time.

    Episode i of seed s begins from ``fold_in(key(s), i)``, whatever the training's seed was. All
    episodes run at once, each in an environment of its own, until the last one has ended.
    """

    def __init__(
        self,
        algorithm: Player,
        env: Any,
        env_params: EnvParams,
        *,
        num_episodes: int = 32,
        seed: int = 1_000_003,
        deterministic: bool = True,
    ) -> None:
        """Compile nothing yet.

        Args:
            algorithm: whose ``act`` plays.
            env: a ``PixelEnv`` that shows pixels.
            env_params: of it.
            num_episodes: E.
            seed: of the episodes.
            deterministic: whether the mean action is played, or a sampled one.
        """
        envs = VectorPixelEnv(env, num_episodes, "disabled")
        self._play = partial(_play, envs, algorithm, deterministic)
        with default_flags():
            self._key = jax.random.key(seed)
        self._params = env_params

    def __call__(self, networks: Networks) -> Result:
        """Play the episodes of a policy."""
        actor = {"actor": networks["actor"]}
        returns, lengths = jax.device_get(self._play(actor, self._key, self._params))
        return Result(returns=returns.astype(np.float64), lengths=lengths)


@jit(lambda envs: envs.env, static_argnums=(0, 1, 2))
def _play(
    envs: VectorPixelEnv,
    algorithm: Player,
    deterministic: bool,
    networks: Networks,
    key: jax.Array,
    params: EnvParams,
) -> tuple[jax.Array, jax.Array]:
    """Return returns and lengths of episodes, (E,) each."""
    num_steps = -(-params.episode_length // envs.env.action_repeat)

    def goes_on(carry: tuple[EnvState, jax.Array, Any]) -> jax.Array:
        _, number, (over, _, _) = carry
        return ~over.all() & (number < num_steps)

    def step(carry: tuple[EnvState, jax.Array, Any]) -> tuple[EnvState, jax.Array, Any]:
        state, number, (over, returns, lengths) = carry
        action_key = None if deterministic else jax.random.fold_in(action_keys, number)
        action = algorithm.act(networks, envs.obs(state), action_key)
        state, timestep = envs.step(state, action, params)
        # Beyond its end an episode goes on without meaning.
        returns = jnp.where(over, returns, timestep.info["episode_return"])
        lengths = jnp.where(over, lengths, timestep.info["episode_length"])
        over |= timestep.terminated | timestep.truncated
        return state, number + 1, (over, returns, lengths)

    # Episode i begins from fold_in(key, i).
    action_keys = jax.random.fold_in(key, envs.num_envs)
    state, _ = envs.reset(key, params)
    nothing = jnp.zeros(envs.num_envs)
    results = (nothing.astype(bool), nothing, nothing.astype(jnp.int32))
    carry = jax.lax.while_loop(goes_on, step, (state, jnp.int32(0), results))
    return carry[2][1], carry[2][2]


@dataclass(frozen=True)
class Interval:
    """A statistic with its interval of confidence."""

    value: float
    low: float
    high: float


def interquartile_mean(scores: np.ndarray, *, confidence: float = 0.95, seed: int = 0) -> Interval:
    """Return the mean of the middle half of scores, with a bootstrap interval over runs.

    Recommended for a handful of runs by Agarwal et al., arXiv 2108.13264.

    Args:
        scores: (R,) one score for each run, at least 2.
        confidence: of the interval, in (0, 1).
        seed: of the resampling.

    Raises:
        ValueError: there are fewer than 2 scores.
    """
    from scipy import stats

    scores = np.asarray(scores, np.float64)
    if scores.ndim != 1 or len(scores) < 2:
        raise ValueError(f"scores must be at least 2 numbers, got shape {scores.shape}.")
    resampled = np.random.default_rng(seed).choice(scores, (10_000, len(scores)))
    means = stats.trim_mean(resampled, 0.25, axis=1)
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(stats.trim_mean(scores, 0.25)), float(low), float(high))
