"""Dynamics and tasks: what moves, what it earns, when it ends."""

from typing import TYPE_CHECKING, Any

from pixelbrax_jax.physics.base import BACKENDS, Kinematics, Physics
from pixelbrax_jax.physics.mjcf_task import mjcf_physics
from pixelbrax_jax.physics.tasks import REWARD_PRESETS, TASKS, TaskSpec, make_physics

if TYPE_CHECKING:
    from pixelbrax_jax.physics.brax_physics import BraxPhysics

__all__ = [
    "BACKENDS",
    "REWARD_PRESETS",
    "TASKS",
    "BraxPhysics",
    "Kinematics",
    "Physics",
    "TaskSpec",
    "make_physics",
    "mjcf_physics",
]


def __getattr__(name: str) -> Any:
    # Importing Brax takes seconds; a program that only lists tasks need not pay them.
    if name == "BraxPhysics":
        from pixelbrax_jax.physics.brax_physics import BraxPhysics

        return BraxPhysics
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
