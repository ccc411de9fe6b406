"""The algorithms by name."""

from __future__ import annotations

from collections.abc import Callable

import jax

from pixelbrax_jax.agents.algorithm import Algorithm, train_function
from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.off_policy.drqv2 import DrQv2
from pixelbrax_jax.agents.on_policy.dcpg import DCPG
from pixelbrax_jax.agents.on_policy.ppg import PPG
from pixelbrax_jax.agents.on_policy.ppo import PPO
from pixelbrax_jax.agents.rollout import Environments
from pixelbrax_jax.agents.train_state import Metrics, TrainState
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.types import EnvParams

ALGORITHMS: dict[str, type[Algorithm]] = {kind.name: kind for kind in (PPO, PPG, DCPG, DrQv2)}
"""Algorithm classes by name."""


def make_algorithm(config: TrainConfig, envs: Environments) -> Algorithm:
    """Make the algorithm of these settings; settings of another class are a TypeError."""
    for kind in ALGORITHMS.values():
        if type(config) is kind.config_class:
            return kind(config, envs)
    known = ", ".join(kind.config_class.__name__ for kind in ALGORITHMS.values())
    raise TypeError(f"config must be one of {known}, got {type(config).__name__}.")


def make_train(
    config: TrainConfig,
    envs: Environments | None = None,
    env_params: EnvParams | None = None,
) -> Callable[[jax.Array], tuple[TrainState, Metrics]]:
    """Return a whole run as a pure function ``train(key) -> (state, metrics)``.

    The function works under ``jax.jit`` and, over keys, ``jax.vmap``. Metrics have a leading axis
    of iterations; those of the auxiliary phase have an axis of phases. ``envs`` and ``env_params``
    default to the environments of ``config``.

    Raises:
        TypeError: no algorithm has settings of this class.
        ValueError: only one of ``envs`` and ``env_params`` is given.
    """
    if envs is None and env_params is None:
        env, env_params = make_env(config)
        envs = VectorPixelEnv(env, config.num_envs)
    if envs is None or env_params is None:
        missing = "envs" if envs is None else "env_params"
        raise ValueError(f"envs and env_params must be given together, got no {missing}.")
    return train_function(make_algorithm(config, envs), env_params)
