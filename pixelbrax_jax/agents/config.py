"""What all algorithms have in common: the task, the rollout, the networks."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any

from pixelbrax_jax.agents.networks import ENCODERS, LOG_STD_RANGE, POLICIES, SMALLEST
from pixelbrax_jax.choices import check_choice, check_share, check_whole
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.registry import make
from pixelbrax_jax.types import EnvParams

ADVANTAGE_NORMS = ("batch", "minibatch", "none")


@dataclass(frozen=True)
class TrainConfig:
    """Settings that every algorithm has."""

    task: str = "ant"
    """Task, one of ``pixelbrax_jax.list_envs()``."""
    backend: str | None = None
    """Physics engine; none means the task's own."""
    reward_preset: str = "brax"
    """``brax``, or ``paper`` for the rewards of arXiv 2502.00021."""
    height: int = 84
    """Pixels of a frame."""
    width: int = 84
    """Pixels of a frame."""
    frame_stack: int = 3
    """Frames in one observation."""
    action_repeat: int = 1
    """Control steps for each action."""
    episode_length: int = 1000
    """Time limit in control steps."""
    distractors: tuple[str, ...] = ()
    """Names of distractors, such as ``video`` or ``dcs-easy``."""
    clips: str | None = None
    """Folder of the videos that a video distractor plays, or ``procedural``."""

    total_steps: int = 25_000_000
    """Control steps of the whole run, over all environments; rounded up to whole rollouts."""
    num_envs: int = 256
    """Environments N."""
    num_steps: int = 64
    """Steps T of each environment in one rollout."""

    encoder: str = "impala"
    """``impala``, ``nature``, ``drq`` or ``small``."""
    policy: str = "gaussian"
    """``gaussian``, ``tanh_gaussian`` or ``deacrep``."""
    initial_std: float = 1.0
    """Standard deviation of a new policy, unless it is ``deacrep``."""
    state_critic: bool = False
    """Whether a separate critic sees the simulator's state in place of pixels."""
    random_shift: int = 0
    """Pixels by which pictures are shifted at most, one random shift for each rollout."""

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
        """Checks the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        for name in (
            "height",
            "width",
            "frame_stack",
            "action_repeat",
            "episode_length",
            "total_steps",
            "num_envs",
            "num_steps",
            "num_minibatches",
        ):
            check_whole(name, getattr(self, name))
        check_choice("encoder", self.encoder, ENCODERS)
        check_choice("policy", self.policy, POLICIES)
        check_choice("normalize_advantage", self.normalize_advantage, ADVANTAGE_NORMS)
        for name in ("gamma", "gae_lambda", "clip_coef"):
            check_share(name, getattr(self, name))
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
        if min(self.height, self.width) < smallest:
            raise ValueError(
                f"encoder {self.encoder!r} needs pictures of at least {smallest} x {smallest} "
                f"pixels, got {self.height} x {self.width}; another encoder takes smaller ones."
            )
        check_divides("num_steps", self.num_steps, "num_minibatches", self.num_minibatches)

    @property
    def steps_per_iteration(self) -> int:
        """Control steps that one rollout counts."""
        return self.num_envs * self.num_steps * self.action_repeat

    @property
    def num_iterations(self) -> int:
        """Rollouts of the whole run."""
        return -(-self.total_steps // self.steps_per_iteration)


def make_env(config: TrainConfig, **changes: Any) -> tuple[PixelEnv, EnvParams]:
    """The environment that a configuration names, and its parameters.

    Args:
        config: of any algorithm.
        changes: options of ``pixelbrax_jax.make`` that shall be others.
    """
    names = (
        "backend",
        "reward_preset",
        "height",
        "width",
        "frame_stack",
        "action_repeat",
        "episode_length",
        "distractors",
        "clips",
    )
    options = {name: getattr(config, name) for name in names}
    options["obs_mode"] = "both" if config.state_critic else "pixels"
    return make(config.task, **(options | changes))


def describe(config: TrainConfig) -> dict[str, Any]:
    """All settings by name, as JSON has them."""
    values = {field.name: getattr(config, field.name) for field in fields(config)}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def check_positive(name: str, value: object, or_zero: bool = False) -> None:
    """Rejects what is not a positive, finite number.

    Raises:
        ValueError: otherwise, naming the setting.
    """
    known = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not (known and (value > 0 or (or_zero and value == 0))):  # type: ignore[operator]
        wanted = "a number of at least 0" if or_zero else "a positive number"
        raise ValueError(f"{name} must be {wanted}, got {value!r}.")


def check_count(name: str, value: object) -> None:
    """Rejects what is not a whole number of at least 0.

    Raises:
        ValueError: otherwise, naming the setting.
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}.")


def check_divides(whole: str, size: int, part: str, count: int) -> None:
    """Rejects a number of parts into which a whole cannot be cut.

    Raises:
        ValueError: with the next counts that would do.
    """
    if size % count:
        allowed = [str(n) for n in range(1, size + 1) if size % n == 0]
        raise ValueError(
            f"{part}={count} must divide {whole}={size}; it may be {', '.join(allowed)}."
        )
