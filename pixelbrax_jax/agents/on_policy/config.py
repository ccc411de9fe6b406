"""Settings of every on-policy algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from pixelbrax_jax.agents.config import (
    Count,
    Fraction,
    NotNegative,
    Positive,
    PositiveInt,
    TrainConfig,
    check_divides,
)
from pixelbrax_jax.agents.networks.actor_critic import LOG_STD_RANGE, POLICIES
from pixelbrax_jax.validation import check_choice


@dataclass(frozen=True)
class OnPolicyConfig(TrainConfig):
    """Settings of rollouts, the policy and PPO's objective."""

    memory_settings: ClassVar[tuple[str, ...]] = ("num_envs", "num_steps")

    num_steps: PositiveInt = 64
    """Number of steps T of each environment in a rollout."""
    random_shift: Count = 0
    """Shifts images randomly by up to this many pixels, once per rollout."""
    policy: str = "gaussian"
    """Distribution of the actions: ``gaussian``, ``tanh_gaussian`` or ``deacrep``."""
    initial_std: Positive = 1.0
    """Initial standard deviation of a ``gaussian`` or ``tanh_gaussian`` policy."""

    gae_lambda: Fraction = 0.95
    """Lambda of generalised advantage estimation."""
    num_minibatches: PositiveInt = 8
    """Number of minibatches per epoch, with T / num_minibatches steps of every environment each."""
    clip_coef: Fraction = 0.2
    """Epsilon of PPO's clipped ratio."""
    ent_coef: NotNegative = 0.001
    """Weight of the entropy bonus."""
    normalize_advantage: str = "batch"
    """Normalises advantages over the ``batch`` or the ``minibatch``, or not at all: ``none``."""
    normalize_reward: bool = True
    """Divides rewards by the standard deviation of discounted returns."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_divides("num_steps", self.num_steps, "num_minibatches", self.num_minibatches)
        check_choice("policy", self.policy, POLICIES)
        norms = ("batch", "minibatch", "none")
        check_choice("normalize_advantage", self.normalize_advantage, norms)
        low, high = (math.exp(x) for x in LOG_STD_RANGE)
        if not low < self.initial_std < high:
            raise ValueError(
                f"initial_std must be between {low:.4f} and {high:.2f}, the limits of standard "
                f"deviations, got {self.initial_std}."
            )

    @property
    def steps_per_iteration(self) -> int:
        """Control steps of one rollout over all environments."""
        return self.num_envs * self.num_steps * self.env.action_repeat

    @property
    def bytes_per_iteration(self) -> int:
        """Bytes of the frames of one rollout over all environments."""
        frames = self.num_envs * (self.num_steps + self.env.frame_stack - 1)
        return frames * self.frame_bytes
