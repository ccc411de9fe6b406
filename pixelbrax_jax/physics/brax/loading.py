"""Loading of Brax's tasks."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.base import Kinematics
from pixelbrax_jax.physics.brax.engine import BraxPhysics
from pixelbrax_jax.physics.brax.tasks import TASKS, BraxOptions, BraxTask
from pixelbrax_jax.physics.divergence import Recipe
from pixelbrax_jax.physics.mujoco.compatibility import (
    import_silenced,
    load_onto_own_device,
    loading_silenced,
)
from pixelbrax_jax.spatial import make_rig
from pixelbrax_jax.types import CameraRig
from pixelbrax_jax.validation import check_choice

with import_silenced():
    from brax import envs
    from mujoco.mjx._src import io as mjx_io


def distance_swum(before: Kinematics, after: Kinematics, action: jax.Array) -> jax.Array:
    """Return the distance of the swimmer's root from the origin, minus a control cost."""
    del before
    return jnp.linalg.norm(after.q[:2]) - 1e-9 * jnp.sum(action**2)


_PAPER_REWARDS = {"distance_swum": distance_swum}


def load(task: str, options: BraxOptions) -> BraxPhysics:
    """Load the physics of a Brax task. Equal arguments give equal objects.

    ``backend=None`` takes the task's default. ``reward_preset="paper"`` has the rewards of arXiv
    2502.00021 where they differ from the installed Brax's: walker2d's forward reward is ten times
    higher, the swimmer's reward is its distance from the origin, and humanoid, humanoidstandup,
    inverted_pendulum and pusher take actions unscaled. Dynamics are the same.
    """
    row = TASKS[task]
    backend = row.default_backend if options.backend is None else options.backend
    check_choice(f"backend of task {task!r}", backend, row.backends)
    return _load(task, backend, options.reward_preset)


# Loading a model takes a second. A model that is loaded again equals the first one.
@lru_cache(maxsize=16)
def _load(task: str, backend: str, reward_preset: str) -> BraxPhysics:
    row, paper = TASKS[task], reward_preset == "paper"
    return BraxPhysics(
        load_brax_env(task, backend, **(row.paper_options if paper else {})),
        colors=row.colors,
        drawn_radius=row.drawn_radius,
        rigs=rigs_of(row),
        unscale_actions=paper and row.paper_unscaled,
        reward=_PAPER_REWARDS[row.paper_reward] if paper and row.paper_reward else None,
        identity=Recipe(_load, (task, backend, reward_preset)),
    )


def rigs_of(task: BraxTask) -> dict[str, CameraRig]:
    """Return a task's viewpoints by name: ``default``, and ``original`` if the paper has one."""
    views = {"default": task.camera or task.original_camera, "original": task.original_camera}
    return {name: make_rig(**vars(view)) for name, view in views.items() if view is not None}


def load_brax_env(name: str, backend: str, **options: Any) -> envs.Env:
    """Load a bare Brax environment by name, without its known warnings."""
    load_onto_own_device(mjx_io)
    with loading_silenced():
        return envs.get_environment(name, backend=backend, **options)
