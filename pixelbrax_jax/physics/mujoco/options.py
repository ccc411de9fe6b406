"""Options of all tasks that MuJoCo simulates. Importing it loads no physics."""

from __future__ import annotations

from dataclasses import dataclass

from pixelbrax_jax.validation import check_choice, check_count

ENGINES = ("auto", "mujoco", "xla", "mjx")
"""Names of the engines."""


@dataclass(frozen=True, kw_only=True)
class MujocoOptions:
    """Options of tasks that MuJoCo simulates; raises ValueError for one that is out of range."""

    engine: str = "auto"
    """Engine of DM Control's and Gymnasium's tasks: ``mujoco`` (MuJoCo itself, on a CPU), ``xla``
    (MuJoCo XLA, on any device and with gradients), ``mjx`` (the same with no stage of our own), or
    ``auto``: ``mujoco`` in programs for a CPU, ``xla`` in others."""
    num_starts: int = 0
    """Number of initial states that are made once, for each episode to draw one; 0 samples a new
    one for each. An accelerator computes the reset of all environments in every step, in which
    DM Control's cheetah takes 200 physics steps to settle; 4096 are usual there."""

    def __post_init__(self) -> None:
        check_choice("engine", self.engine, ENGINES)
        check_count("num_starts", self.num_starts)
