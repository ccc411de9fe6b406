"""What an algorithm is: settings, environments, and the steps that carry training on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.on_policy.losses import Metrics
from pixelbrax_jax.agents.on_policy.returns import RewardScaler
from pixelbrax_jax.agents.on_policy.rollout import Environments
from pixelbrax_jax.agents.optimizer import Networks, Optimizer
from pixelbrax_jax.agents.train_state import TrainState, env_key, network_key
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams


class Agent(Protocol):
    """The networks of an algorithm."""

    def init(self, key: jax.Array) -> Networks:
        """Sample initial parameters, by name of the network."""

    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """As ``Algorithm.act``."""


@dataclass(frozen=True)
class Algorithm(ABC):
    """An algorithm with its settings, as pure functions.

    Algorithms of equal settings in equal environments are equal, and share compiled programs.

    Attributes:
        config: its settings, of ``config_class``.
        envs: the environments it plays in.
        name: what it is called.
        config_class: the class of its settings.

    Raises:
        ValueError: the environments are not what the settings say.
    """

    config: TrainConfig
    envs: Environments
    name: ClassVar[str]
    config_class: ClassVar[type[TrainConfig]] = TrainConfig

    def __post_init__(self) -> None:
        """Check the environments."""
        check_environments(self.config, self.envs)

    @property
    def num_phases(self) -> int:
        """After how many iterations the auxiliary phase comes; 0 means never."""
        return 0

    @property
    @abstractmethod
    def agent(self) -> Agent:
        """Its networks."""

    @under_default_flags
    def init_networks(self, key: jax.Array) -> Networks:
        """Sample initial parameters, by name of the network."""
        return self.agent.init(key)

    @under_default_flags
    def init(self, key: jax.Array, env_params: EnvParams) -> TrainState:
        """Return the state before the first iteration.

        Args:
            key: typed PRNG key of the run.
            env_params: of the environments.
        """
        networks = self.init_networks(network_key(key))
        env_state, _ = self.envs.reset(env_key(key), env_params)
        return TrainState(
            networks=networks,
            opt_state=Optimizer(self.config).init(networks),
            aux_opt_state=None,
            env_state=env_state,
            scaler=RewardScaler.start(self.config.num_envs),
            buffer=None,
            key=key,
            iteration=jnp.uint32(0),
        )

    @abstractmethod
    def iterate(self, state: TrainState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """Play a rollout and learn from it.

        Args:
            state: where training stands.
            env_params: of the environments.

        Returns:
            The state after it, and scalars.
        """

    def auxiliary(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """Learn from the rollouts of all iterations since the last auxiliary phase."""
        raise NotImplementedError(f"{self.name} has no auxiliary phase.")

    @under_default_flags
    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """Return actions.

        Args:
            networks: parameters; those of ``"actor"`` are enough.
            pixels: (N, H, W, 3 K) uint8.
            key: for sampled actions; None returns the mean ones.

        Returns:
            (N, A) float32.
        """
        return self.agent.act(networks, pixels, key)


def environments(
    config: TrainConfig, envs: Environments | None, env_params: EnvParams | None
) -> tuple[Environments, EnvParams]:
    """Return the given environments and their parameters, or those that ``config`` names.

    Raises:
        ValueError: one of the two is given without the other.
    """
    if envs is not None and env_params is not None:
        return envs, env_params
    if envs is not None or env_params is not None:
        missing = "envs" if envs is None else "env_params"
        raise ValueError(f"envs and env_params belong together, got no {missing}.")
    env, env_params = make_env(config)
    return VectorPixelEnv(env, config.num_envs), env_params


def check_environments(config: TrainConfig, envs: Environments) -> None:
    """Reject environments that are not what the settings say.

    Raises:
        ValueError: naming the setting and both values.
        TypeError: they cannot be hashed, which programs are shared by.
    """
    try:
        hash(envs)
    except TypeError as error:
        raise TypeError(
            f"environments must be hashable, got a {type(envs).__name__}: make it a frozen "
            "dataclass, or leave its __eq__ alone."
        ) from error
    if envs.autoreset_mode != "next_step":
        raise ValueError(
            f"autoreset_mode of the environments must be 'next_step', got {envs.autoreset_mode!r}."
        )
    specs = envs.env.obs_spec
    specs = specs if isinstance(specs, dict) else {"pixels": specs}
    spec = specs.get("pixels")
    if spec is None or len(spec.shape) != 3 or (config.state_critic and "state" not in specs):
        wanted = "both" if config.state_critic else "pixels"
        raise ValueError(
            f"obs_mode of the environments must be {wanted!r} with "
            f"state_critic={config.state_critic}; they show {', '.join(specs)}."
        )
    found = {
        "num_envs": (config.num_envs, envs.num_envs),
        "action_repeat": (config.env.action_repeat, envs.env.action_repeat),
        "frame_stack": (config.env.frame_stack, spec.shape[-1] // 3),
        "height": (config.env.height, spec.shape[0]),
        "width": (config.env.width, spec.shape[1]),
    }
    for name, (expected, given) in found.items():
        if expected != given:
            raise ValueError(
                f"{name} is {expected} in the settings, but {given} in the environments."
            )


def train_function(
    algorithm: Algorithm, env_params: EnvParams
) -> Callable[[jax.Array], tuple[TrainState, Metrics]]:
    """Return a whole run as a pure function of a key.

    The function may be jitted, and mapped over keys by ``jax.vmap``.

    Args:
        algorithm: with its settings.
        env_params: of the environments.

    Returns:
        ``train(key) -> (state, metrics)``; metrics have a leading axis of iterations, those of the
        auxiliary phase one of phases.
    """
    iterations, phases = algorithm.config.num_iterations, algorithm.num_phases

    def several(state: TrainState, number: int) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda state, _: algorithm.iterate(state, env_params), state, length=number
        )

    def phase(state: TrainState, _: None) -> tuple[TrainState, tuple[Metrics, Metrics]]:
        state, metrics = several(state, phases)
        state, aux_metrics = algorithm.auxiliary(state)
        return state, (metrics, aux_metrics)

    @under_default_flags
    def train(key: jax.Array) -> tuple[TrainState, Metrics]:
        state = algorithm.init(key, env_params)
        if not phases:
            return several(state, iterations)
        state, (metrics, aux_metrics) = jax.lax.scan(phase, state, length=iterations // phases)
        metrics = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), metrics)
        if iterations % phases:
            state, rest = several(state, iterations % phases)
            metrics = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), metrics, rest)
        return state, metrics | aux_metrics

    return train
