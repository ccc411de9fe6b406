"""The built-in tasks, one row each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from pixelbrax_jax.choices import check_choice
from pixelbrax_jax.physics.base import BACKENDS, Kinematics

if TYPE_CHECKING:
    from pixelbrax_jax.physics.brax_physics import BraxPhysics

Color = tuple[float, float, float]
REWARD_PRESETS = ("brax", "paper")

# Okabe and Ito's colors ("Color Universal Design", 2008), told apart with any color vision.
_SKY_BLUE = (0.337, 0.706, 0.914)
_VERMILLION = (0.835, 0.369, 0.0)
_RED = (1.0, 0.0, 0.0)


def _distance_swum(before: Kinematics, after: Kinematics, action: jax.Array) -> jax.Array:
    """Distance of the swimmer's root from the origin, minus the control cost."""
    del before
    return jnp.linalg.norm(after.q[:2]) - 1e-9 * jnp.sum(action**2)


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """What we know about one task.

    Attributes:
        name: Brax's name.
        default_backend: the engine used unless told otherwise.
        backends: the engines that simulate this task sanely.
        colors: colors by geom name that replace Brax's.
        paper_options: arguments of Brax's environment for the "paper" preset.
        paper_unscaled: whether the "paper" preset hands actions to costs and actuators as
            they are, where Brax first maps them from [-1, 1] to the control range.
        paper_reward: the "paper" preset's reward, None for Brax's.
    """

    name: str
    default_backend: str
    backends: tuple[str, ...] = BACKENDS
    colors: Mapping[str, Color] = field(default_factory=dict)
    paper_options: Mapping[str, float] = field(default_factory=dict)
    paper_unscaled: bool = False
    paper_reward: Callable[[Kinematics, Kinematics, jax.Array], jax.Array] | None = None


_ROWS = (
    TaskSpec("ant", "spring"),
    TaskSpec("halfcheetah", "spring"),
    TaskSpec("hopper", "positional"),
    TaskSpec("humanoid", "spring", paper_unscaled=True),
    TaskSpec("humanoidstandup", "spring", paper_unscaled=True),
    TaskSpec("inverted_double_pendulum", "generalized"),
    TaskSpec("inverted_pendulum", "generalized", paper_unscaled=True),
    TaskSpec(
        "pusher",
        "generalized",
        # The goal disc has no name in Brax's model. 
        colors={"object_geom": _SKY_BLUE, "capsule/20": _VERMILLION},
        paper_unscaled=True,
    ),
    TaskSpec("reacher", "generalized", colors={"fingertip": _SKY_BLUE, "target": _RED}),
    TaskSpec(
        "swimmer", "generalized", ("generalized",), paper_reward=_distance_swum
    ),
    TaskSpec("walker2d", "spring", paper_options={"forward_reward_weight": 10.0}),
)
TASKS: Mapping[str, TaskSpec] = MappingProxyType({row.name: row for row in _ROWS})


def make_physics(
    task: str, *, backend: str | None = None, reward_preset: str = "brax"
) -> BraxPhysics:
    """The physics of a built-in task."""
    spec = TASKS[check_choice("task", task, TASKS)]
    check_choice("reward_preset", reward_preset, REWARD_PRESETS)
    if backend is None:
        backend = spec.default_backend
    check_choice(f"backend of task {task!r}", backend, spec.backends)
    # Importing Brax takes seconds, the table above must not.
    from pixelbrax_jax.physics.brax_physics import BraxPhysics, load_brax_env

    paper = reward_preset == "paper"
    env = load_brax_env(task, backend, **(spec.paper_options if paper else {}))
    return BraxPhysics(
        env,
        colors=spec.colors,
        unscale_actions=paper and spec.paper_unscaled,
        reward=spec.paper_reward if paper else None,
    )
