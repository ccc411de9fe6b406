"""The built-in tasks that Brax simulates."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.base import Kinematics
from pixelbrax_jax.physics.brax.engine import BraxPhysics
from pixelbrax_jax.physics.mujoco_compatibility import (
    import_silenced,
    load_onto_own_device,
    loading_silenced,
)
from pixelbrax_jax.physics.recipe import Recipe
from pixelbrax_jax.tasks import BRAX_TASKS, REWARD_PRESETS
from pixelbrax_jax.validation import check_choice

with import_silenced():
    from brax import envs
    from mujoco.mjx._src import io as mjx_io


def distance_swum(before: Kinematics, after: Kinematics, action: jax.Array) -> jax.Array:
    """Return the distance of the swimmer's root from the origin, minus a control cost."""
    del before
    return jnp.linalg.norm(after.q[:2]) - 1e-9 * jnp.sum(action**2)


_PAPER_REWARDS = {"distance_swum": distance_swum}


def make_physics(
    task: str, *, backend: str | None = None, reward_preset: str = "brax"
) -> BraxPhysics:
    """Make the physics of a built-in task.

    Equal arguments give equal objects, and the same one as long as few others are asked for.

    Args:
        task: a name in ``BRAX_TASKS``.
        backend: a backend that the task supports; None for its default.
        reward_preset: ``"brax"`` for the rewards of the installed Brax, or ``"paper"`` for
            those of arXiv 2502.00021 where they differ: walker2d weighs forward speed ten
            times, the swimmer earns its distance from the origin, and humanoid,
            humanoidstandup, inverted_pendulum and pusher take actions unscaled. Dynamics are
            the installed Brax's with either.

    Returns:
        The physics.

    Raises:
        ValueError: for an unknown name; the message lists what is allowed.
    """
    row = BRAX_TASKS[check_choice("task", task, BRAX_TASKS)]
    check_choice("reward_preset", reward_preset, REWARD_PRESETS)
    backend = row.default_backend if backend is None else backend
    check_choice(f"backend of task {task!r}", backend, row.backends)
    return _load(task, backend, reward_preset)


# Loading a model takes a second. One that is dropped and loaded again equals the first.
@lru_cache(maxsize=16)
def _load(task: str, backend: str, reward_preset: str) -> BraxPhysics:
    row, paper = BRAX_TASKS[task], reward_preset == "paper"
    reward = _PAPER_REWARDS[row.paper_reward] if paper and row.paper_reward else None
    return BraxPhysics(
        load_brax_env(task, backend, **(row.paper_options if paper else {})),
        colors=row.colors,
        drawn_radius=row.drawn_radius,
        # These tasks' pictures and viewpoints are those of the original.
        sites_and_cameras=False,
        unscale_actions=paper and row.paper_unscaled,
        reward=reward,
        identity=Recipe(_load, (task, backend, reward_preset)),
    )


def load_brax_env(name: str, backend: str, **options: Any) -> envs.Env:
    """Load one of Brax's own environments, bare, without its known warnings.

    Args:
        name: Brax's name of the task.
        backend: Brax's name of the backend.
        **options: further arguments of the environment's class.

    Returns:
        The environment.
    """
    load_onto_own_device(mjx_io)
    with loading_silenced():
        return envs.get_environment(name, backend=backend, **options)
