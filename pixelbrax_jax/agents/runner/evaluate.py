"""Evaluate a policy on complete, reproducible episodes."""

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
    """The (E,) float64 returns and (E,) int lengths, in control steps, of E episodes."""

    returns: np.ndarray
    lengths: np.ndarray

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return; NaN for a single episode."""
        if len(self.returns) < 2:
            return float("nan")
        return float(self.returns.std(ddof=1) / np.sqrt(len(self.returns)))


class Evaluator:
    """Runs ``num_episodes`` complete episodes in parallel, the same ones every time.

    Episode i starts from ``fold_in(key(seed), i)``, whatever the seed of the training.
    ``deterministic`` selects mean actions, otherwise actions are sampled.
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
        """Prepare the evaluation of ``algorithm.act`` in ``env``, a ``PixelEnv`` with pixels."""
        envs = VectorPixelEnv(env, num_episodes, "disabled")
        self._play = partial(_play, envs, algorithm, deterministic)
        self._acting = algorithm.acting
        with default_flags():
            self._key = jax.random.key(seed)
        self._params = env_params

    def __call__(self, networks: Networks) -> Result:
        """Evaluate the policy of these networks."""
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
    """Return the (E,) returns and lengths of the episodes."""
    num_steps = -(-params.episode_length // envs.env.action_repeat)

    def goes_on(carry: tuple[EnvState, jax.Array, Any]) -> jax.Array:
        _, number, (over, _, _) = carry
        return ~over.all() & (number < num_steps)

    def step(carry: tuple[EnvState, jax.Array, Any]) -> tuple[EnvState, jax.Array, Any]:
        state, number, (over, returns, lengths) = carry
        action_key = None if deterministic else jax.random.fold_in(action_keys, number)
        action = algorithm.act(networks, envs.obs(state), action_key)
        state, timestep = envs.step(state, action, params)
        # Results after the end of an episode are ignored.
        returns = jnp.where(over, returns, timestep.info["episode_return"])
        lengths = jnp.where(over, lengths, timestep.info["episode_length"])
        over |= timestep.terminated | timestep.truncated
        return state, number + 1, (over, returns, lengths)

    # Reset i uses fold_in(key, i), so the actions use the next number.
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
    """Evaluate an agent with mean actions; yield a row of JSON values after each split.

    ``episodes`` is the number per split. Without ``splits`` it evaluates all available ones.
    ``clips`` is a folder; None uses the training's.

    Raises:
        ValueError: an option is out of range, or the run has no such split.
        FileNotFoundError: the folder of the clips is missing.
    """
    check_positive_int("episodes", episodes)
    config, shown = with_clips(agent, clips)
    if clips and not shown:
        report(f"the run has no digest of its clips; assuming that {clips} has the same clips")
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
    """Join the episodes of several runs, and return the scalars to log by name."""
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
    """A statistic with its confidence interval."""

    value: float
    low: float
    high: float


def interquartile_mean(scores: np.ndarray, *, confidence: float = 0.95, seed: int = 0) -> Interval:
    """Compute the interquartile mean of (R,) scores with a bootstrap interval over runs.

    Recommended for few runs by Agarwal et al., arXiv 2108.13264. ``confidence`` is in (0, 1).

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
