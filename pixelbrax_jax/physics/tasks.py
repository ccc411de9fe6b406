"""The built-in tasks, one row each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import jax
import jax.numpy as jnp

from pixelbrax_jax.choices import check_choice
from pixelbrax_jax.physics.base import BACKENDS, Kinematics
from pixelbrax_jax.physics.brax_physics import BraxPhysics, RewardFn, load_brax_env
from pixelbrax_jax.physics.geoms import Color

REWARD_PRESETS = ("brax", "paper")

# Okabe and Ito's palette (Color Universal Design, 2008) is told apart with any color vision.
_SKY_BLUE = (0.337, 0.706, 0.914)
_YELLOW = (0.941, 0.894, 0.259)
_VERMILLION = (0.835, 0.369, 0.0)
_RED = (1.0, 0.0, 0.0)


def _distance_swum(before: Kinematics, after: Kinematics, action: jax.Array) -> jax.Array:
    """Distance of the swimmer's root from the origin, minus a control cost."""
    del before
    return jnp.linalg.norm(after.q[:2]) - 1e-9 * jnp.sum(action**2)


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """What we know about one task.

    Attributes:
        name: Brax's name.
        default_backend: the engine used unless told otherwise.
        backends: the engines that simulate this task sanely, sorted.
        colors: colors by geom name that replace Brax's.
        drawn_radius: metres, spheres by name that are drawn larger than they are.
        paper_options: arguments of Brax's environment for the "paper" preset.
        paper_unscaled: whether the "paper" preset hands actions to costs and actuators as
            they are, where Brax first maps them from [-1, 1] to the control range. The
            actuators still clip to that range.
        paper_reward: the "paper" preset's reward, None for Brax's.
    """

    name: str
    default_backend: str
    backends: tuple[str, ...] = BACKENDS
    colors: Mapping[str, Color] = field(default_factory=dict)
    drawn_radius: Mapping[str, float] = field(default_factory=dict)
    paper_options: Mapping[str, float] = field(default_factory=dict)
    paper_unscaled: bool = False
    paper_reward: RewardFn | None = None


# Default engines are those of the paper (arXiv 2502.00021), which leaves the choice open for
# ant, humanoid and humanoidstandup and lacks the double pendulum.
_ROWS = (
    # Brax's reset noise puts feet below the ground. The positional engine throws such an ant
    # into the air: a quarter of the episodes ends within four steps, whatever the action.
    TaskSpec("ant", "spring", backends=("generalized", "mjx", "spring")),
    TaskSpec("halfcheetah", "spring"),
    TaskSpec("hopper", "positional"),
    TaskSpec("humanoid", "spring", paper_unscaled=True),
    TaskSpec("humanoidstandup", "spring", paper_unscaled=True),
    TaskSpec("inverted_double_pendulum", "generalized"),
    TaskSpec("inverted_pendulum", "generalized", paper_unscaled=True),
    # The paper's pusher also has another object; its physics are not reproduced.
    TaskSpec(
        "pusher",
        "generalized",
        # The goal disc has no name in Brax's model, only its place in the list.
        colors={"object_geom": _SKY_BLUE, "capsule/20": _VERMILLION},
        paper_unscaled=True,
    ),
    TaskSpec(
        "reacher",
        "generalized",
        colors={"fingertip": _YELLOW, "target": _RED},
        # At 84 pixels their 9 and 10 mm are two pixels.
        drawn_radius={"fingertip": 0.015, "target": 0.018},
    ),
    # Brax itself refuses the swimmer on other engines.
    TaskSpec("swimmer", "generalized", backends=("generalized",), paper_reward=_distance_swum),
    TaskSpec("walker2d", "spring", paper_options={"forward_reward_weight": 10.0}),
)
TASKS: Mapping[str, TaskSpec] = MappingProxyType({row.name: row for row in _ROWS})


def make_physics(
    task: str, *, backend: str | None = None, reward_preset: str = "brax"
) -> BraxPhysics:
    """The physics of a built-in task.

    Args:
        task: a name in ``TASKS``.
        backend: an engine the task supports; None for its default.
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
    spec = TASKS[check_choice("task", task, TASKS)]
    check_choice("reward_preset", reward_preset, REWARD_PRESETS)
    if backend is None:
        backend = spec.default_backend
    check_choice(f"backend of task {task!r}", backend, spec.backends)
    paper = reward_preset == "paper"
    return BraxPhysics(
        load_brax_env(task, backend, **(spec.paper_options if paper else {})),
        colors=spec.colors,
        drawn_radius=spec.drawn_radius,
        unscale_actions=paper and spec.paper_unscaled,
        reward=spec.paper_reward if paper else None,
    )
