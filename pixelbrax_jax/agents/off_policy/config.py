"""Settings of DrQ-v2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pixelbrax_jax.agents.config import (
    Count,
    Finite,
    Fraction,
    NotNegative,
    Positive,
    PositiveInt,
    TrainConfig,
)
from pixelbrax_jax.agents.networks.encoders import LAYERS
from pixelbrax_jax.validation import check_choice


@dataclass(frozen=True)
class DrQv2Config(TrainConfig):
    """Settings of DrQ-v2.

    Defaults are those of its code, except ``num_envs``, ``buffer_size`` and ``saturation_coef``.
    """

    memory_settings: ClassVar[tuple[str, ...]] = ("buffer_size",)

    num_envs: PositiveInt = 16
    """Number of environments N that run in parallel."""
    encoder: str = "drq"
    """Convolutions that encode pixels: ``drq``, ``nature``, ``small``, ``patch`` or ``patch2``."""
    learning_rate: Positive = 1e-4
    """Adam's step size."""
    adam_eps: Positive = 1e-8
    """Adam's epsilon."""
    max_grad_norm: NotNegative = 0.0
    """Clips the gradient of each network to this global norm; 0 disables clipping."""

    num_steps: PositiveInt = 1
    """Number of steps T of each environment between updates."""
    replay_ratio: Positive = 0.5
    """Updates per step of one environment: an iteration has replay_ratio x N x T of them."""
    buffer_size: PositiveInt = 100_000
    """Steps of all environments that the replay stores, rounded up to whole iterations."""
    learning_starts: PositiveInt = 2000
    """Steps of all environments with uniform actions; learning begins when so many are stored."""
    checkpoint_replay: bool = False
    """Stores the replay in checkpoints; without it a resumed run first fills a new one."""

    batch_size: PositiveInt = 256
    """Number of transitions in an update."""
    n_step: PositiveInt = 3
    """Number of rewards n in a return before it bootstraps."""
    random_shift: Count = 4
    """Shifts every sampled observation randomly by up to this many pixels."""
    tau: Fraction = 0.01
    """Share of the critic that its target takes over in an update."""
    policy_delay: PositiveInt = 1
    """Updates of the critic per update of the actor."""
    critic: str = "clipped"
    """Target of the two Q functions: the smaller one (``clipped``), or ``c51``, by which each
    learns its own distribution over atoms."""
    num_atoms: PositiveInt = 101
    """Number of atoms of ``c51``."""
    v_min: Finite = -20.0
    """Smallest return that ``c51`` represents."""
    v_max: Finite = 20.0
    """Largest return that ``c51`` represents."""

    saturation_coef: NotNegative = 1e-3
    """Weight of the mean square of the actor's output before ``tanh``, which keeps its gradient."""
    feature_dim: PositiveInt = 50
    """Size of the bounded features behind the encoder."""
    hidden_dim: PositiveInt = 1024
    """Size of the hidden layers of actor and critic."""
    layer_norm: bool = False
    """Normalises the hidden layers of actor and critic too."""
    bfloat16: bool = False
    """Computes networks in bfloat16; parameters and losses stay float32."""

    initial_std: Positive = 1.0
    """Standard deviation of the exploration noise at first."""
    final_std: Positive = 0.1
    """Standard deviation of the exploration noise after the schedule."""
    std_steps: PositiveInt = 100_000
    """Steps of all environments over which the standard deviation decreases linearly."""
    std_clip: Positive = 0.3
    """Bound of the noise in updates; while playing it has none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("encoder", self.encoder, LAYERS)
        check_choice("critic", self.critic, ("clipped", "c51"))
        if self.state_critic:
            raise ValueError("state_critic must be False for drqv2, whose critic sees pixels.")
        if self.critic == "c51" and not (self.v_min < self.v_max and self.num_atoms > 1):
            raise ValueError(
                f"c51 needs v_min below v_max and at least 2 atoms, got v_min={self.v_min}, "
                f"v_max={self.v_max} and num_atoms={self.num_atoms}."
            )
        self._check_updates()
        self._check_start()
        if self.memory_budget_gb is not None and self.replay_bytes > self.memory_budget_gb * 1e9:
            raise ValueError(
                f"the replay needs {self.replay_bytes:,} bytes, but memory_budget_gb="
                f"{self.memory_budget_gb} allows {int(self.memory_budget_gb * 1e9):,}; "
                f"for frames alone {self.largest_that_fits(self.memory_budget_gb * 1e9)}"
            )

    def _check_updates(self) -> None:
        steps = self.num_envs * self.num_steps
        updates = self.replay_ratio * steps
        if round(updates) < 1 or abs(updates - round(updates)) > 1e-6 * updates:
            nearest = max(1, round(updates)) / steps
            raise ValueError(
                f"replay_ratio={self.replay_ratio} gives {updates:g} updates per iteration of "
                f"num_envs={self.num_envs} x num_steps={self.num_steps} steps, which must be a "
                f"whole number of at least 1; the nearest replay_ratio is {nearest:g}, or change "
                "num_steps."
            )
        # Longest episode in steps of the agent.
        longest = -(-self.env.episode_length // self.env.action_repeat)
        if self.n_step > longest:
            raise ValueError(
                f"n_step={self.n_step} must be at most {longest}, the steps of an episode with "
                f"episode_length={self.env.episode_length} and "
                f"action_repeat={self.env.action_repeat}."
            )

    def _check_start(self) -> None:
        starts, size, batch = self.learning_starts, self.buffer_size, self.batch_size
        if batch > starts:
            raise ValueError(
                f"batch_size={batch} must be at most learning_starts={starts}, the steps that are "
                "stored when learning begins."
            )
        if starts > size:
            raise ValueError(
                f"learning_starts={starts} must be at most buffer_size={size}: the replay never "
                "holds as many steps."
            )
        # A transition needs the frames of its stacks and the steps of its return.
        needed = (self.env.frame_stack + self.n_step) * self.num_envs
        if starts < needed:
            raise ValueError(
                f"learning_starts={starts} must be at least {needed}: frame_stack="
                f"{self.env.frame_stack} and n_step={self.n_step} steps of each of "
                f"num_envs={self.num_envs} environments."
            )
        total = self.total_steps // self.env.action_repeat
        if starts >= total:
            raise ValueError(
                f"learning_starts={starts} must be below {total}, the agent's steps in "
                f"total_steps={self.total_steps}: the run would never learn."
            )

    @property
    def steps_per_iteration(self) -> int:
        """Control steps of one iteration over all environments."""
        return self.num_envs * self.num_steps * self.env.action_repeat

    @property
    def steps_to_fill(self) -> int:
        """See ``TrainConfig.steps_to_fill``."""
        return self.learning_starts

    @property
    def num_updates(self) -> int:
        """Updates of the critic in an iteration."""
        return round(self.replay_ratio * self.num_envs * self.num_steps)

    @property
    def slots(self) -> int:
        """Steps of each environment that the replay stores, a multiple of T."""
        return -(-self.buffer_size // (self.num_envs * self.num_steps)) * self.num_steps

    @property
    def replay_bytes(self) -> int:
        """Bytes of the frames in the replay."""
        return self.slots * self.num_envs * self.frame_bytes

    def to_fit(self, excess: float) -> str:
        """See ``TrainConfig.to_fit``."""
        largest = self.largest_that_fits(max(0.0, self.replay_bytes - excess))
        return f"{super().to_fit(excess)} Of the replay, {largest}"

    def largest_that_fits(self, num_bytes: float) -> str:
        """Name the largest ``buffer_size`` whose frames fit into ``num_bytes``."""
        per_iteration = self.num_envs * self.num_steps
        largest = int(num_bytes // (self.frame_bytes * per_iteration)) * per_iteration
        if largest < max(self.learning_starts, 1):
            return "not even learning_starts fits; choose a smaller height and width."
        return f"the largest that fits is buffer_size={largest}."
