"""Environments made of the options that an adapter was given."""

from __future__ import annotations

from collections import deque
from typing import Any

from pixelbrax_gym.interop.fork import check_not_forked, is_forked
from pixelbrax_jax import EnvConfig, PixelEnv, make
from pixelbrax_jax.config import env_config
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import check_positive_int

_made: deque[tuple[EnvConfig, PixelEnv, EnvParams]] = deque(maxlen=64)
"""Options of the latest environments, so that forks of this process can name them."""


def limited(config: EnvConfig, max_episode_steps: Any, is_limited: bool) -> EnvConfig:
    """Return options whose time limit is no longer than so many calls of ``step``."""
    limit = check_positive_int("max_episode_steps", max_episode_steps) * config.action_repeat
    # Whichever is reached first, as with Gymnasium's own TimeLimit around an environment.
    limit = min(limit, config.episode_length) if is_limited else limit
    return env_config(config, {"episode_length": limit})


def make_env(config: EnvConfig) -> tuple[PixelEnv, EnvParams]:
    """Make an environment and its parameters.

    Raises:
        RuntimeError: this process is a fork that cannot run JAX.
    """
    if is_forked():
        # What exists can be named in a fork without starting JAX. The worker then fails in
        # reset(), where Gymnasium's AsyncVectorEnv passes errors on; from here it would only see
        # a lost pipe.
        for made, env, params in _made:
            if _is_equal(made, config):
                return env, params
        check_not_forked()
    env, params = make(config)
    # Clips take 100 MB, which this list would keep.
    if params.clips is None and not any(_is_equal(made, config) for made, _, _ in _made):
        _made.append((config, env, params))
    return env, params


def _is_equal(one: EnvConfig, other: EnvConfig) -> bool:
    try:
        return one == other
    except ValueError:  # Arrays of a camera or look, which have no truth value.
        return False
