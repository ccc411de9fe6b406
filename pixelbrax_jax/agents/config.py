"""Settings that all algorithms have: the environment, the rollout, the networks."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from types import NoneType
from typing import Any, Self

from pixelbrax_jax.agents.networks.actor import ENCODERS, LOG_STD_RANGE, POLICIES, SMALLEST
from pixelbrax_jax.config import ENV_OPTIONS, EnvConfig
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.envs.making import make
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import (
    check_choice,
    check_fraction,
    check_options,
    check_positive_int,
)

ADVANTAGE_NORMS = ("batch", "minibatch", "none")


@dataclass(frozen=True)
class TrainConfig:
    """Settings that every algorithm has."""

    env: EnvConfig = EnvConfig()  # noqa: RUF009 (it is frozen)
    """Options of the environment; camera, look, clips and distractors as names."""

    total_steps: int = 25_000_000
    """Control steps of the whole run, over all environments; rounded up to whole rollouts."""
    num_envs: int = 256
    """Environments N."""
    num_steps: int = 64
    """Steps T of each environment in one rollout."""

    encoder: str = "impala"
    """``impala``, ``nature``, ``drq``, ``small`` or ``patch``."""
    policy: str = "gaussian"
    """``gaussian``, ``tanh_gaussian`` or ``deacrep``."""
    initial_std: float = 1.0
    """Standard deviation of a new policy, unless it is ``deacrep``."""
    state_critic: bool = False
    """Whether a separate critic sees the simulator's state in place of pixels."""
    random_shift: int = 0
    """Pixels by which images are shifted at most, one random shift for each rollout."""

    gamma: float = 0.99
    """Discount of rewards, for each action."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    learning_rate: float = 3e-4
    """Adam's step size."""
    anneal: bool = False
    """Whether the step size falls to 0 along a line."""
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    max_grad_norm: float = 0.5
    """Global norm to which each network's gradient is clipped; 0 clips nothing."""
    num_minibatches: int = 8
    """Minibatches of an epoch; each has T / num_minibatches steps of every environment."""
    clip_coef: float = 0.2
    """Epsilon of PPO's clipped ratio."""
    ent_coef: float = 0.001
    """Weight of the entropy bonus."""
    normalize_advantage: str = "batch"
    """Over what advantages get mean 0 and deviation 1: ``batch``, ``minibatch`` or ``none``."""
    normalize_reward: bool = True
    """Whether rewards are divided by the deviation of discounted returns."""
    memory_budget_gb: float | None = None
    """Bytes, in 10^9, that stored frames may take; none asks the device."""

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        _check_env(self.env)
        for name in ("total_steps", "num_envs", "num_steps", "num_minibatches"):
            check_positive_int(name, getattr(self, name))
        check_choice("encoder", self.encoder, ENCODERS)
        check_choice("policy", self.policy, POLICIES)
        check_choice("normalize_advantage", self.normalize_advantage, ADVANTAGE_NORMS)
        for name in ("gamma", "gae_lambda", "clip_coef"):
            check_fraction(name, getattr(self, name))
        for name in ("learning_rate", "initial_std", "adam_eps"):
            check_positive(name, getattr(self, name))
        for name in ("max_grad_norm", "ent_coef"):
            check_positive(name, getattr(self, name), or_zero=True)
        low, high = (math.exp(x) for x in LOG_STD_RANGE)
        if not low < self.initial_std < high:
            raise ValueError(
                f"initial_std must be between {low:.4f} and {high:.2f}, where standard deviations "
                f"are kept, got {self.initial_std}."
            )
        check_count("random_shift", self.random_shift)
        if self.memory_budget_gb is not None:
            check_positive("memory_budget_gb", self.memory_budget_gb)
        smallest = SMALLEST[self.encoder]
        if min(self.env.height, self.env.width) < smallest:
            raise ValueError(
                f"encoder {self.encoder!r} needs images of at least {smallest} x {smallest} "
                f"pixels, got {self.env.height} x {self.env.width}; another encoder takes smaller "
                "ones."
            )
        check_divides("num_steps", self.num_steps, "num_minibatches", self.num_minibatches)

    @property
    def steps_per_iteration(self) -> int:
        """Control steps that one rollout counts."""
        return self.num_envs * self.num_steps * self.env.action_repeat

    @property
    def num_iterations(self) -> int:
        """Rollouts of the whole run."""
        return -(-self.total_steps // self.steps_per_iteration)

    def replace(self, **settings: Any) -> Self:
        """Return these settings with others, those of the environment among them by their names.

        Args:
            **settings: as ``num_envs=64`` and ``height=64``, which is that of ``env``.

        Raises:
            TypeError: a name is unknown; the message lists those there are.
            ValueError: a setting is out of range; the message says what is allowed.
        """
        own = [field.name for field in fields(self)]
        check_options(settings, [*own, *ENV_OPTIONS])
        of_env = {name: settings.pop(name) for name in ENV_OPTIONS if name in settings}
        if of_env:
            settings["env"] = replace(settings.get("env", self.env), **of_env)
        return replace(self, **settings)


def _check_env(env: EnvConfig) -> None:
    """Reject an environment whose options JSON has nothing for, or that shows no pixels."""
    if not isinstance(env, EnvConfig):
        raise TypeError(f"env must be an EnvConfig, got {env!r}.")
    for name, kind in (("camera", str), ("look", str), ("clips", (str, NoneType))):
        if not isinstance(value := getattr(env, name), kind):
            raise TypeError(f"{name} of training settings must be a name, got {value!r}.")
    if not all(isinstance(item, str) for item in as_tuple(env.distractors)):
        raise TypeError(f"distractors of training settings must be names, got {env.distractors!r}.")
    if env.obs_mode != "pixels":
        raise ValueError(
            f"obs_mode of training settings must be 'pixels', got {env.obs_mode!r}; a critic "
            "sees the simulator's state with state_critic=True."
        )


def make_env(config: TrainConfig, **changes: Any) -> tuple[PixelEnv, EnvParams]:
    """Make the environment that a configuration names, and its parameters.

    Args:
        config: of any algorithm.
        **changes: fields of ``EnvConfig`` that shall be others.
    """
    obs_mode = "both" if config.state_critic else "pixels"
    return make(config.env, **({"obs_mode": obs_mode} | changes))


def describe(config: TrainConfig) -> dict[str, Any]:
    """Return all settings by name, those of the environment among them, as JSON has them."""
    names = [field.name for field in fields(config) if field.name != "env"]
    values = {name: getattr(config.env, name) for name in ENV_OPTIONS}
    values |= {name: getattr(config, name) for name in names}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def check_positive(name: str, value: object, or_zero: bool = False) -> None:
    """Reject what is not a positive, finite number.

    Raises:
        ValueError: otherwise, naming the setting.
    """
    known = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not (known and (value > 0 or (or_zero and value == 0))):  # type: ignore[operator]
        wanted = "a number of at least 0" if or_zero else "a positive number"
        raise ValueError(f"{name} must be {wanted}, got {value!r}.")


def check_count(name: str, value: object) -> None:
    """Reject what is not a whole number of at least 0.

    Raises:
        ValueError: otherwise, naming the setting.
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}.")


def check_divides(whole: str, size: int, part: str, count: int) -> None:
    """Reject a number of parts into which a whole cannot be cut.

    Raises:
        ValueError: with the next counts that would do.
    """
    if size % count:
        allowed = [str(n) for n in range(1, size + 1) if size % n == 0]
        raise ValueError(
            f"{part}={count} must divide {whole}={size}; it may be {', '.join(allowed)}."
        )
