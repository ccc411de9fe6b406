"""The interface of an algorithm, and a whole training run as a pure function."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.rollout import Environments, split_obs
from pixelbrax_jax.agents.train_state import Metrics, Networks, TrainState
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.observations import IMAGES, check_obs_mode
from pixelbrax_jax.types import EnvParams


@dataclass(frozen=True)
class Algorithm(ABC):
    """An algorithm with its settings and environments, as pure functions.

    Equal settings in equal environments share compiled programs. ``acting`` names the networks that
    ``act`` needs. With several runs in one program, a CPU computes ``iterate`` for one run after
    the other, which copies their states, or for all by ``jax.vmap`` with ``vmaps_runs``.

    Raises:
        ValueError: the environments contradict the settings.
        TypeError: the environments cannot be hashed.
    """

    config: TrainConfig
    envs: Environments
    name: ClassVar[str]
    config_class: ClassVar[type[TrainConfig]] = TrainConfig
    acting: ClassVar[tuple[str, ...]] = ("actor",)
    vmaps_runs: ClassVar[bool] = False

    def __post_init__(self) -> None:
        config, envs = self.config, self.envs
        try:
            hash(envs)
        except TypeError as error:
            raise TypeError(
                f"environments must be hashable, got a {type(envs).__name__}: make it a frozen "
                "dataclass, or define __hash__ along with __eq__."
            ) from error
        if (mode := envs.autoreset_mode) != "next_step":
            raise ValueError(
                f"autoreset_mode of the environments must be 'next_step', got {mode!r}."
            )
        pixels, state = split_obs(envs.env.obs_spec)
        mode = config.env.obs_mode
        fits = pixels is not None and len(pixels.shape) == 3 and pixels.dtype == IMAGES[mode].dtype
        if not fits or (config.state_critic and state is None):
            wanted = check_obs_mode(mode + "+state") if config.state_critic else mode
            raise ValueError(
                f"obs_mode of the environments must be {wanted!r} with "
                f"state_critic={config.state_critic}, but their obs_spec is {envs.env.obs_spec}."
            )
        found = {
            "the number of cameras": (config.env.num_cameras, envs.env.num_cameras),
            "num_envs": (config.num_envs, envs.num_envs),
            "action_repeat": (config.env.action_repeat, envs.env.action_repeat),
            "frame_stack": (config.env.frame_stack, pixels.shape[-1] // config.frame_channels),
            "height": (config.env.height, pixels.shape[0]),
            "width": (config.env.width, pixels.shape[1]),
        }
        for name, (expected, given) in found.items():
            if expected != given:
                raise ValueError(
                    f"{name} is {expected} in the settings, but {given} in the environments."
                )

    @abstractmethod
    def init(self, key: jax.Array, env_params: EnvParams) -> TrainState:
        """Return the initial state of a run; ``key`` is a typed PRNG key."""

    @abstractmethod
    def iterate(self, state: Any, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """Collect ``config.steps_per_iteration`` control steps and learn from them.

        Returns the state, with ``iteration`` increased by 1, and scalars that include
        ``Rollout.episode_metrics``.
        """

    @abstractmethod
    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """Return (N, A) float32 actions for (N, H, W, 3 K) uint8 pixels, or float32 depths.

        Needs only the networks in ``acting``. A key samples the actions; None returns the best.
        In the exported policy N is symbolic: ``pixels.shape[0]`` is no number.
        """

    def warnings(self, record: Mapping[str, float]) -> list[str]:
        """Return warnings about a record of the metrics; each is reported once per run."""
        del record
        return []

    @property
    def auxiliary_every(self) -> int:
        """Iterations between auxiliary phases; 0 if the algorithm has none."""
        return 0

    def auxiliary(self, state: Any) -> tuple[TrainState, Metrics]:
        """Learn from the data stored since the last auxiliary phase."""
        raise NotImplementedError(f"{self.name} has no auxiliary phase.")


def train_function(
    algorithm: Algorithm, env_params: EnvParams
) -> Callable[[jax.Array], tuple[TrainState, Metrics]]:
    """Return a whole run of an algorithm as a pure function; see ``make_train``."""
    iterations, every = algorithm.config.num_iterations, algorithm.auxiliary_every

    def several(state: TrainState, number: int) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda state, _: algorithm.iterate(state, env_params), state, length=number
        )

    def phase(state: TrainState, _: None) -> tuple[TrainState, tuple[Metrics, Metrics]]:
        state, metrics = several(state, every)
        state, aux_metrics = algorithm.auxiliary(state)
        return state, (metrics, aux_metrics)

    @under_default_flags
    def train(key: jax.Array) -> tuple[TrainState, Metrics]:
        state = algorithm.init(key, env_params)
        if not every:
            return several(state, iterations)
        state, (metrics, aux_metrics) = jax.lax.scan(phase, state, length=iterations // every)
        metrics = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), metrics)
        if iterations % every:
            state, rest = several(state, iterations % every)
            metrics = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), metrics, rest)
        return state, metrics | aux_metrics

    return train
