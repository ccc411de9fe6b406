"""The smallest agents that have everything, and what their states are compared by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import EnvParams, PixelEnv, VectorPixelEnv
from pixelbrax_jax.agents import DCPG, PPG, PPO, DrQv2
from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.train_state import TrainState
from pixelbrax_jax.config import EnvConfig
from tests.envs.toy import Ball, limited

EPISODE_LENGTH = 5
PARAMS = limited(EPISODE_LENGTH)
OPTIONS = {"height": 18, "width": 18, "frame_stack": 2}
SMALL: dict[str, Any] = {
    "env": EnvConfig(**OPTIONS, episode_length=EPISODE_LENGTH),
    "encoder": "small",
    "num_envs": 4,
    "num_steps": 8,
    "num_minibatches": 2,
    "random_shift": 1,
    # A few iterations with steps that show.
    "total_steps": 4 * 8 * 5,
    "learning_rate": 3e-3,
    "anneal": True,
}
ABOUT: dict[str, Any] = {"algorithm": "ppg", "config": {}}
"""What is stored with the checkpoints of no run in particular."""
PHASIC = {"num_policy_phases": 2, "aux_minibatches": 4, "aux_epochs": 2}
REPLAY = {
    "replay_ratio": 0.125,
    "buffer_size": 64,
    "learning_starts": 32,
    "batch_size": 8,
    "n_step": 2,
    "feature_dim": 8,
    "hidden_dim": 16,
}


def settings_of(kind: type[Algorithm]) -> dict[str, Any]:
    """Return those settings of ``SMALL``, ``PHASIC`` and ``REPLAY`` that the algorithm has."""
    known = kind.config_class.__dataclass_fields__
    return {name: x for name, x in (SMALL | PHASIC | REPLAY).items() if name in known}


def ball_envs() -> VectorPixelEnv:
    """What ``SMALL`` names, with the ball."""
    return VectorPixelEnv(PixelEnv(Ball(), **OPTIONS), SMALL["num_envs"])


@cache
def _first_state(algorithm: Algorithm, seed: int) -> TrainState:
    return algorithm.init(jax.random.key(seed), PARAMS)


@dataclass(frozen=True)
class Agent:
    """An algorithm, the parts of which are compiled once for equal ones."""

    algorithm: Algorithm

    @property
    def config(self) -> Any:
        return self.algorithm.config

    @partial(jax.jit, static_argnums=0)
    def iterate(self, state: TrainState) -> Any:
        return self.algorithm.iterate(state, PARAMS)

    @partial(jax.jit, static_argnums=0)
    def auxiliary(self, state: TrainState) -> Any:
        return self.algorithm.auxiliary(state)

    def init(self, seed: int = 0) -> TrainState:
        return _first_state(self.algorithm, seed)

    def run(self, state: TrainState, iterations: int) -> tuple[TrainState, dict[str, Any]]:
        """As ``train_function`` does; the metrics are the last ones of either phase."""
        phases, metrics = self.algorithm.auxiliary_every, {}
        for number in range(iterations):
            state, facts = self.iterate(state)
            metrics |= facts
            if phases and number % phases == phases - 1:
                state, facts = self.auxiliary(state)
                metrics |= facts
        return state, metrics

    def without_steps(self, state: TrainState) -> TrainState:
        """``state`` after the last iteration: annealed, the step size is 0 from there on."""
        return state.replace(iteration=jnp.uint32(self.config.num_iterations))


def small_agent(kind: type[Algorithm], **settings: Any) -> Agent:
    """An agent of ``settings_of``, with other settings."""
    return Agent(kind(kind.config_class(**settings_of(kind) | settings), ball_envs()))


AGENTS = {
    "ppo": small_agent(PPO, update_epochs=1, vf_coef=1.0),
    "ppg": small_agent(PPG),
    "dcpg": small_agent(DCPG),
    # With everything there is: a critic of its own, an averaged actor, and a dynamics head.
    "decoupled": small_agent(DCPG, decoupled=True, dynamics_coef=1.0),
}
"""On-policy algorithms."""

DRQV2 = small_agent(DrQv2)


def with_iterate(
    algorithm: Algorithm, iterate: Callable[[TrainState, EnvParams], Any]
) -> Algorithm:
    """Return the algorithm with another ``iterate``; it is equal to itself alone."""

    class Changed(type(algorithm)):
        def iterate(self, state, env_params):
            return iterate(state, env_params)

    return Changed(algorithm.config, algorithm.envs)


def arrays(tree: Any) -> list[np.ndarray]:
    """All leaves; those of random keys as their words."""
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


def same(one: Any, other: Any) -> bool:
    """Whether two trees are equal to the last bit."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    return all(np.array_equal(a, b) for a, b in zip(arrays(one), arrays(other), strict=True))


def assert_close(one: Any, other: Any, **tolerance: float) -> None:
    """Two trees are equal up to rounding."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(arrays(one), arrays(other), strict=True):
        np.testing.assert_allclose(a, b, **tolerance)
