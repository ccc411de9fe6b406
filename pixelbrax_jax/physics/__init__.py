"""Dynamics and tasks: what moves, what it earns, when it ends."""

from pixelbrax_jax.physics.base import BACKENDS, Kinematics, Physics
from pixelbrax_jax.physics.brax_physics import BraxPhysics
from pixelbrax_jax.physics.mjcf_task import mjcf_physics
from pixelbrax_jax.physics.tasks import REWARD_PRESETS, TASKS, TaskSpec, make_physics

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
