"""What a task of the DM Control Suite consists of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
from flax import struct

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.snapshot import Snapshot
from pixelbrax_jax.physics.opengl import mujoco


class Start(struct.PyTreeNode):
    """An initial state.

    Attributes:
        qpos: (Q,) float32, joint positions: metres, radians, unit quaternions.
        qvel: (V,) float32, joint velocities, per second; None means at rest.
        target: (3,) float32, metres, this episode's target; (7,) with its unit quaternion, where it
            is a body; None for tasks without.
    """

    qpos: jax.Array
    qvel: jax.Array | None = None
    target: jax.Array | None = None


def _unchanged(model: mujoco.MjModel) -> None:
    del model


@dataclass(frozen=True, eq=False)
class Formulas:
    """One task: its model, how episodes begin, what is observed and rewarded.

    Attributes:
        domain: the model's name in DM Control's suite.
        start: draws an initial state from a key.
        observe: returns the observation, in DM Control's order.
        reward: returns the reward, in [0, 1].
        substeps: physics steps per control step.
        edit: changes the compiled model as DM Control's task does.
        options: arguments of the model's generator.
        camera: index of the model's camera that is the task's own.
        movable: names of the geoms, sites and lights that ``Start.target`` moves.
        target_body: name of the body, fixed to the world, that it moves; empty for none.
        reads_forces: whether observations have sensors of forces or accelerations.
        starts_with_forces: whether these read something else than 0 in an initial state.
        out_of_reach: names of the geoms that nothing ever touches, in any pose.
        batch_last: whether a CPU computes a batch faster with the environments as last axis.
    """

    domain: str
    start: Callable[[Dynamics, jax.Array], Start]
    observe: Callable[[Snapshot], jax.Array]
    reward: Callable[[Snapshot], jax.Array]
    substeps: int = 1
    edit: Callable[[mujoco.MjModel], None] = _unchanged
    options: Mapping[str, Any] = field(default_factory=dict)
    camera: int = 0
    movable: tuple[str, ...] = ()
    target_body: str = ""
    reads_forces: bool = False
    starts_with_forces: bool = False
    out_of_reach: tuple[str, ...] = ()
    batch_last: bool = True
