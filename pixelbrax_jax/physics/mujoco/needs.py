"""What a task's formulas need of the engine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, eq=False, kw_only=True)
class Needs:
    """What a task's formulas need of the engine.

    Attributes:
        target_body: name of the body, fixed to the world, that ``Start.target`` moves; empty for
            none.
        reads_forces: whether observations use sensors of forces or accelerations.
        starts_with_forces: whether these sensors are not 0 in an initial state that it samples.
        prefers_xla: whether "auto" steps by MuJoCo XLA on a CPU, too, because it is faster.
        out_of_reach: geoms that never touch anything, which MuJoCo XLA then skips.
        reads: fields of ``MjData`` that the formulas see as MuJoCo's last step leaves them:
            computed before its motion, as in Gymnasium.
    """

    target_body: str = ""
    reads_forces: bool = False
    starts_with_forces: bool = False
    prefers_xla: bool = False
    out_of_reach: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
