"""How good a policy is: whole episodes, the same ones every time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.agents.runner.progress import Report, silent
from pixelbrax_jax.agents.runner.settings import place_of
from pixelbrax_jax.agents.runner.splits import make_splits
from pixelbrax_jax.agents.runner.trained import Player, Trained, with_clips
from pixelbrax_jax.agents.train_state import Networks
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.types import EnvParams, EnvState
from pixelbrax_jax.validation import check_positive_int


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
        self._acting = algorithm.acting
        with default_flags():
            self._key = jax.random.key(seed)
        self._params = env_params

    def __call__(self, networks: Networks) -> Result:
        """Play the episodes of a policy."""
        acting = {name: networks[name] for name in self._acting}
        returns, lengths = jax.device_get(self._play(acting, self._key, self._params))
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


def evaluate(
    agent: Trained,
    *,
    episodes: int = 32,
    splits: Sequence[str] = (),
    clips: str | None = None,
    report: Report = silent,
) -> Iterator[dict[str, Any]]:
    """Yield a row for each split, as soon as its episodes are played: what JSON has.

    Args:
        agent: who plays, with mean actions.
        episodes: of each split.
        splits: names, all of which must be there; without any, those that are there.
        clips: folder of the clips, in place of that of the training.
        report: gets a line about what is left out or not known.

    Raises:
        ValueError: an option is out of range, or there is no such split.
        FileNotFoundError: the folder of the clips is missing.
    """
    check_positive_int("episodes", episodes)
    config, shown = with_clips(agent, clips)
    if clips and not shown:
        report(f"the run has no digest of its clips; those of {clips} are taken for them")
    for name, (env, params) in make_splits(config, splits, shown=shown, report=report):
        result = Evaluator(agent.algorithm, env, params, num_episodes=episodes)(agent.networks)
        row = {
            "steps": agent.steps,
            "seed": agent.seed,
            "split": name,
            "episodes": episodes,
            "return": result.mean,
            "length": float(result.lengths.mean()),
        }
        if params.clips is not None:
            row["clips"] = place_of(str(config.env.clips or "procedural"))
        if episodes > 1:
            row["standard_error"] = result.standard_error
        yield row


def together(runs: Sequence[Result]) -> tuple[Result, dict[str, float]]:
    """Return all episodes of several runs, and what is logged of them, by name."""
    logged = {}
    if len(runs) > 1:
        middle = interquartile_mean(np.array([run.mean for run in runs]))
        logged = {f"return/run_{number}": run.mean for number, run in enumerate(runs)}
        logged |= {"iqm": middle.value, "iqm_low": middle.low, "iqm_high": middle.high}
    result = Result(
        returns=np.concatenate([run.returns for run in runs]),
        lengths=np.concatenate([run.lengths for run in runs]),
    )
    logged |= {"return": result.mean, "length": float(result.lengths.mean())}
    if len(result.returns) > 1:
        logged["standard_error"] = result.standard_error
    return result, logged


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
