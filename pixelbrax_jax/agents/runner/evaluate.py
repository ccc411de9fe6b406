"""How good a policy is: fixed episodes, with and without distractors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.agents.core.config import TrainConfig, make_env
from pixelbrax_jax.agents.core.optimizer import Networks
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.types import EnvParams, EnvState
from pixelbrax_jax.validation import check_choice

SPLITS = ("clean", "train", "test")

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


def make_splits(config: TrainConfig) -> dict[str, tuple[PixelEnv, EnvParams]]:
    """Return environments to evaluate in, by name of the split.

    ``clean`` has no distractors, ``train`` those of the training, and ``test`` the same with
    clips that training never shows: of the split ``test`` or, if ``train`` is within the name of
    the training's, that with ``test`` in its place. Without distractors there is only ``clean``.
    """
    return {name: make_split(config, name) for name in splits_of(config)}


def splits_of(config: TrainConfig) -> tuple[str, ...]:
    """Return names of the splits that there are."""
    return SPLITS if config.distractors else SPLITS[:1]


def make_split(config: TrainConfig, name: str) -> tuple[PixelEnv, EnvParams]:
    """Return one of the environments of `make_splits`.

    Raises:
        ValueError: there is no such split.
    """
    check_choice("split", name, SPLITS)
    if name not in splits_of(config):
        raise ValueError(
            f"split {name!r} is for distractors, and the run had none; there is only 'clean'."
        )
    changes = {
        "clean": WITHOUT_DISTRACTORS,
        # That of the training, whatever it is called.
        "train": {},
        "test": {"split": config.split.replace("train", "test")},
    }[name]
    # What training sees of the state, evaluation need not.
    return make_env(config, obs_mode="pixels", **changes)


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
