"""Options of all tasks that MuJoCo simulates. Importing it loads no physics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from pixelbrax_jax.validation import check_choice, check_count


class Engine(NamedTuple):
    """How an engine computes.

    Attributes:
        made_by: module in ``physics/mujoco`` and class, with the methods of ``xla.Xla``; None if
            MuJoCo itself computes, on a CPU alone.
        by_mujoco: whether MuJoCo itself computes programs for a CPU.
        has_derivatives: whether what the class computes has derivatives.
    """

    made_by: str | None
    by_mujoco: bool = False
    has_derivatives: bool = True


ENGINES = {
    "auto": Engine("xla:Xla", by_mujoco=True),
    "mujoco": Engine(None, by_mujoco=True),
    "xla": Engine("xla:Xla"),
    "mjx": Engine("xla:Mjx"),
    "warp": Engine("warp:Warp", has_derivatives=False),
}


@dataclass(frozen=True, kw_only=True)
class MujocoOptions:
    """Options of tasks that MuJoCo simulates; raises ValueError for one that is out of range."""

    engine: str = "auto"
    """Engine of DM Control's and Gymnasium's tasks: ``mujoco`` (MuJoCo itself, on a CPU), ``xla``
    (MuJoCo XLA, on any device and with gradients), ``mjx`` (the same with no stage of our own),
    ``warp`` (MuJoCo Warp, for NVIDIA GPUs; not yet run on one), or
    ``auto``: in programs for a CPU ``mujoco``, but ``xla`` for a few small models that it steps
    faster; in others ``xla``."""
    num_starts: int = 0
    """Number of initial states, such as 4096, that a process makes once, in seconds, the same for
    all seeds; each episode starts from one of them. 0 samples a new state for each episode. On an
    accelerator every step computes resets, in which DM Control's cheetah settles for 200 physics
    steps."""

    def __post_init__(self) -> None:
        check_choice("engine", self.engine, ENGINES)
        num_starts = check_count("num_starts", self.num_starts)
        object.__setattr__(self, "num_starts", num_starts)
