"""Evaluate a policy on complete, reproducible episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.agents.rollout import split_obs
from pixelbrax_jax.agents.runner.trained import Player
from pixelbrax_jax.agents.train_state import Networks
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.generalisation.intervals import interquartile_mean
from pixelbrax_jax.generalisation.suites import EPISODES
from pixelbrax_jax.types import EnvParams, EnvState


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
        """Standard error of the mean return, for at least 2 episodes."""
        return float(self.returns.std(ddof=1) / np.sqrt(len(self.returns)))

    @property
    def scalars(self) -> dict[str, float]:
        """Mean return and length and, for at least 2 episodes, the standard error, by name."""
        means = {"return": self.mean, "length": float(self.lengths.mean())}
        return means | ({"standard_error": self.standard_error} if len(self.returns) > 1 else {})


class Evaluator:
    """Runs whole episodes with mean actions, number i with ``fold_in(key(EPISODES), i)``."""

    def __init__(
        self, algorithm: Player, env: PixelEnv, env_params: EnvParams, *, num_episodes: int = 32
    ) -> None:
        """Prepare the evaluation of ``algorithm.act`` in ``env``, which must show pixels."""
        self._algorithm, self._params = algorithm, env_params
        self._envs = VectorPixelEnv(env, num_episodes, "disabled")

    def __call__(self, networks: Networks) -> Result:
        """Evaluate the policy of these networks."""
        acting = {name: networks[name] for name in self._algorithm.acting}
        played = _play(self._envs, self._algorithm, acting, self._params)
        returns, lengths = jax.device_get(played)
        return Result(returns=returns.astype(np.float64), lengths=lengths)


@jit(static_argnums=(0, 1))
def _play(
    envs: VectorPixelEnv, algorithm: Player, networks: Networks, params: EnvParams
) -> tuple[jax.Array, jax.Array]:
    """Return the (E,) returns and lengths of the episodes."""
    num_steps = -(-params.episode_length // envs.env.action_repeat)

    def goes_on(carry: tuple[EnvState, jax.Array, Any]) -> jax.Array:
        _, number, (over, _, _) = carry
        return ~over.all() & (number < num_steps)

    def step(carry: tuple[EnvState, jax.Array, Any]) -> tuple[EnvState, jax.Array, Any]:
        state, number, (over, returns, lengths) = carry
        # Training environments may also show the state, for a critic.
        pixels, _ = split_obs(envs.obs(state))
        action = algorithm.act(networks, pixels)
        state, timestep = envs.step(state, action, params)
        # Results after the end of an episode are ignored.
        returns = jnp.where(over, returns, timestep.info["episode_return"])
        lengths = jnp.where(over, lengths, timestep.info["episode_length"])
        over |= timestep.terminated | timestep.truncated
        return state, number + 1, (over, returns, lengths)

    state, _ = envs.reset(jax.random.key(EPISODES), params)
    nothing = jnp.zeros(envs.num_envs)
    results = (nothing.astype(bool), nothing, nothing.astype(jnp.int32))
    carry = jax.lax.while_loop(goes_on, step, (state, jnp.int32(0), results))
    return carry[2][1], carry[2][2]


def together(runs: Sequence[Result]) -> tuple[Result, dict[str, float]]:
    """Join the episodes of several runs, and return the scalars to log by name."""
    logged = {}
    if len(runs) > 1:
        middle = interquartile_mean(np.array([run.mean for run in runs]))
        logged = {f"return/run_{number}": run.mean for number, run in enumerate(runs)}
        logged |= zip(("iqm", "iqm_low", "iqm_high"), middle, strict=True)
    result = Result(
        returns=np.concatenate([run.returns for run in runs]),
        lengths=np.concatenate([run.lengths for run in runs]),
    )
    return result, logged | result.scalars


def paired(here: Result, there: Result) -> dict[str, float]:
    """Compare the returns of the same episodes in two places.

    ``difference`` is the mean of there minus here. For at least 2 episodes it has a standard error
    and the bounds of a 95 % interval, by Student's t distribution.
    """
    from scipy import stats

    differences = there.returns - here.returns
    mean, count = float(differences.mean()), len(differences)
    compared = {"return_there": there.mean, "difference": mean}
    if count > 1:
        error = float(differences.std(ddof=1) / np.sqrt(count))
        reach = float(stats.t.ppf(0.975, count - 1)) * error
        compared["difference_standard_error"] = error
        compared |= {"difference_low": mean - reach, "difference_high": mean + reach}
    return compared
