"""Brax's tasks, one row each, and their options. Importing it loads no physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pixelbrax_jax.physics.task import Color, Task, by_name
from pixelbrax_jax.validation import check_choice

BACKENDS = ("generalized", "mjx", "positional", "spring")
"""Names of Brax's physics backends."""

REWARD_PRESETS = ("brax", "paper")

_Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class BraxOptions:
    """Options of Brax's tasks; raises ValueError for one that is out of range."""

    backend: str | None = None
    """Physics backend of Brax's tasks: ``spring``, ``positional``, ``generalized`` or ``mjx``. None
    takes the default of the task."""
    reward_preset: str = "brax"
    """Rewards of Brax's tasks: ``brax``, or ``paper`` for those of arXiv 2502.00021."""

    def __post_init__(self) -> None:
        check_choice("reward_preset", self.reward_preset, REWARD_PRESETS)


@dataclass(frozen=True)
class Viewpoint:
    """Camera of a task: arguments of ``make_rig``."""

    eye: _Point
    target: _Point
    fovy: float
    link: int = -1
    up: _Point = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class BraxTask(Task):
    """A task of Brax, with Brax's name.

    Attributes:
        default_backend: the default physics backend.
        original_camera: the paper's viewpoint, None if it has none.
        camera: the default viewpoint, None for the paper's.
        backends: backends that simulate the task correctly, sorted.
        colors: colors by geom name that replace the model's.
        drawn_radius: metres, by name of a sphere that is rendered larger than it is.
        paper_options: arguments of Brax's environment for the "paper" reward preset.
        paper_unscaled: whether that preset passes actions unchanged to costs and actuators, where
            Brax first maps them from [-1, 1] to the control range. Actuators still clip to it.
        paper_reward: name of that preset's reward in ``loading``, None for Brax's.
        reward: Brax's formula, with the action a, or the control u that an action is mapped to.
        ends: when an episode ends before the time limit; empty for never.
        observation: entries of the state, see ``tests/benchmarks/formula_texts.py``.
    """

    default_backend: str
    original_camera: Viewpoint | None
    camera: Viewpoint | None = None
    backends: tuple[str, ...] = BACKENDS
    colors: Mapping[str, Color] = field(default_factory=dict)
    drawn_radius: Mapping[str, float] = field(default_factory=dict)
    paper_options: Mapping[str, float] = field(default_factory=dict)
    paper_unscaled: bool = False
    paper_reward: str | None = None
    reward: str = ""
    ends: str = ""
    observation: tuple[str, ...] = ()


# Okabe and Ito's palette (Color Universal Design, 2008) can be distinguished with any color vision.
_SKY_BLUE = (0.337, 0.706, 0.914)
_YELLOW = (0.941, 0.894, 0.259)
_VERMILLION = (0.835, 0.369, 0.0)
_RED = (1.0, 0.0, 0.0)

_HUMANOID_STATE = (
    "``qpos[2:]``",
    "``qvel``",
    "``10 * (model.nbody - 1)`` of each link: inertia about the center of mass, and mass",
    "``6 * (model.nbody - 1)`` of each link: velocity times its part of the mass (m/s), and "
    "angular velocity (rad/s)",
    "``model.nv`` of each degree of freedom: torque of its actuator, N m",
)
_WALKER_STATE = (
    "``1`` height of the torso, m",
    "``qpos[2:]``",
    "``qvel`` clipped to [-10, 10]",
)

# Viewpoints of the original renderer (arXiv 2502.00021). Its field of view is horizontal, which for
# square images equals the vertical one.
_ANT = Viewpoint((1.6, -1.6, 3.5), (0.0, 0.0, 0.0), 40.0, link=0)
_PLANAR = Viewpoint((0.0, -2.1, 0.8), (0.0, 0.0, 0.6), 55.0, link=0)
_HUMANOID = Viewpoint((1.7, -1.7, 1.5), (0.0, 0.0, 1.1), 50.0, link=0)
_CART = Viewpoint((0.0, -2.3, 0.0), (0.0, 0.0, 0.0), 55.0)
_PUSHER = Viewpoint((1.6, 1.6, 0.75), (0.0, 0.0, 0.0), 50.0, link=0)
_REACHER = Viewpoint((0.0, -0.01, 0.81), (0.0, 0.0, 0.0), 45.0, link=0, up=(0.0, 1.0, 1.0))
_SWIMMER = Viewpoint((2.4, 2.4, 1.25), (0.0, 0.0, 0.0), 50.0, link=1)
# The original aims above the lying torso, which then sits at the lower edge.
_LYING = Viewpoint((2.2, -2.2, 1.7), (0.0, 0.0, 0.55), 50.0, link=0)

# Default backends are the paper's, which names none for ant, humanoid and humanoidstandup and lacks
# the double pendulum. ``success_return`` of the pendulums is Gymnasium's ``reward_threshold``, and
# of tasks that PPO learns from pixels halfway between no action and PPO (docs/results.md).
TASKS = by_name(
    [
        BraxTask(
            "ant",
            "PixelBrax/Ant-v0",
            "A four-legged body runs along x; ends when its torso is too low or too high.",
            "spring",
            _ANT,
            # Brax's reset noise puts feet below the ground, and the positional backend then throws
            # the ant into the air: a quarter of the episodes ends within four steps.
            backends=("generalized", "mjx", "spring"),
            success_return=1600.0,
            reward="``v + 1 - 0.5 * sum(a ** 2)``; v: velocity of the torso along x, m/s",
            ends="when the torso's height is outside [0.2, 1] m",
            observation=("``qpos[2:]``", "``qvel``"),
        ),
        BraxTask(
            "halfcheetah",
            "PixelBrax/HalfCheetah-v0",
            "A planar two-legged body runs along x; never ends early.",
            "spring",
            _PLANAR,
            success_return=1500.0,
            reward="``v - 0.1 * sum(a ** 2)``; v: velocity of the torso along x, m/s",
            observation=("``qpos[1:]``", "``qvel``"),
        ),
        BraxTask(
            "hopper",
            "PixelBrax/Hopper-v0",
            "A planar one-legged body hops along x; ends when it falls.",
            "positional",
            _PLANAR,
            reward="``v + 1 - 0.001 * sum(a ** 2)``; v: velocity of the torso along x, m/s",
            ends="when the torso's height is at most 0.7 m, its angle beyond 0.2 rad, or another "
            "position or velocity reaches 100",
            observation=_WALKER_STATE,
        ),
        BraxTask(
            "humanoid",
            "PixelBrax/Humanoid-v0",
            "A humanoid runs along x; ends when its torso is too low or too high.",
            "spring",
            _HUMANOID,
            paper_unscaled=True,
            success_return=750.0,
            reward="``1.25 * v + 5 - 0.1 * sum(u ** 2)``; v: velocity of the center of mass along "
            "x, m/s",
            ends="when the torso's height is outside [1, 2] m",
            observation=_HUMANOID_STATE,
        ),
        BraxTask(
            "humanoidstandup",
            "PixelBrax/HumanoidStandup-v0",
            "A humanoid that lies on its back stands up; never ends early.",
            "spring",
            _HUMANOID,
            camera=_LYING,
            paper_unscaled=True,
            reward="``z / {physics.dt!g} + 1 - 0.01 * sum(u ** 2)``; z: height of the torso, m",
            observation=_HUMANOID_STATE,
        ),
        BraxTask(
            "inverted_double_pendulum",
            "PixelBrax/InvertedDoublePendulum-v0",
            "A cart balances two poles in a row; ends when the tip sinks to 1 m.",
            "generalized",
            None,
            camera=Viewpoint((0.0, -3.0, 0.6), (0.0, 0.0, 0.6), 55.0),
            success_return=9100.0,
            reward="``10 - 0.01 * x ** 2 - (z - 2) ** 2 - 0.001 * w1 ** 2 - 0.005 * w2 ** 2``, "
            "without the 10 at the end; x, z: the tip, m; w1, w2: velocities of the hinges, rad/s",
            ends="when the tip's height is at most 1 m",
            observation=(
                "``qpos[:1]``",
                "``2`` sines of both hinges",
                "``2`` cosines of both hinges",
                "``qvel`` clipped to [-10, 10]",
            ),
        ),
        BraxTask(
            "inverted_pendulum",
            "PixelBrax/InvertedPendulum-v0",
            "A cart balances a pole; ends when it tilts by more than 0.2 rad.",
            "generalized",
            _CART,
            paper_unscaled=True,
            success_return=950.0,
            reward="1 a control step, also at the end",
            ends="when the pole's angle is beyond 0.2 rad",
            observation=("``qpos``", "``qvel``"),
        ),
        # The paper's pusher also has another object; its physics are not reproduced.
        BraxTask(
            "pusher",
            "PixelBrax/Pusher-v0",
            "A robot arm pushes a cylinder to a goal; never ends early.",
            "generalized",
            _PUSHER,
            # The goal disc has no name in Brax's model, so it is capsule/20.
            colors={"object_geom": _SKY_BLUE, "capsule/20": _VERMILLION},
            paper_unscaled=True,
            reward="``-0.5 * near - away - 0.1 * sum(u ** 2)``; near: metres from the object to "
            "the wrist, away: from the object to the goal, both before the step",
            observation=(
                "``qpos[:7]``",
                "``qvel[:7]``",
                "``9`` centers of mass of wrist, object and goal, m",
            ),
        ),
        BraxTask(
            "reacher",
            "PixelBrax/Reacher-v0",
            "A planar arm of two joints reaches for a target; never ends early.",
            "generalized",
            _REACHER,
            colors={"fingertip": _YELLOW, "target": _RED},
            # At 84 pixels their 9 and 10 mm are two pixels.
            drawn_radius={"fingertip": 0.015, "target": 0.018},
            reward="``-d - sum(a ** 2)``; d: metres from the fingertip to the target",
            observation=(
                "``2`` cosines of both hinges",
                "``2`` sines of both hinges",
                "``qpos[2:]``",
                "``2`` velocity of the fingertip: x and y, m/s",
                "``3`` from the target to the fingertip, m",
            ),
        ),
        BraxTask(
            "swimmer",
            "PixelBrax/Swimmer-v0",
            "A planar chain of three links swims along x; never ends early.",
            "generalized",
            _SWIMMER,
            # Brax rejects the swimmer on other backends.
            backends=("generalized",),
            paper_reward="distance_swum",
            reward="``v - 0.0001 * sum(a ** 2)``; v: velocity of the first link along x, m/s",
            observation=("``qpos[2:]``", "``qvel``"),
        ),
        BraxTask(
            "walker2d",
            "PixelBrax/Walker2d-v0",
            "A planar two-legged body walks along x; ends when it falls.",
            "spring",
            _PLANAR,
            paper_options={"forward_reward_weight": 10.0},
            reward="``v + 1 - 0.001 * sum(a ** 2)``; v: velocity of the torso along x, m/s",
            ends="when the torso's height leaves (0.8, 2) m, or its angle (-1, 1) rad",
            observation=_WALKER_STATE,
        ),
    ]
)
"""Brax's tasks by name."""
