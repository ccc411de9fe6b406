"""The built-in tasks, one row each: plain names and numbers, so that reading them loads nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

Vector = tuple[float, float, float]
Color = tuple[float, float, float]

BRAX_BACKENDS = ("generalized", "mjx", "positional", "spring")
"""Names of Brax's physics backends."""

REWARD_PRESETS = ("brax", "paper")

# Okabe and Ito's palette (Color Universal Design, 2008) can be distinguished with any color vision.
_SKY_BLUE = (0.337, 0.706, 0.914)
_YELLOW = (0.941, 0.894, 0.259)
_VERMILLION = (0.835, 0.369, 0.0)
_RED = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class View:
    """A viewpoint, as ``scene.cameras.rig`` takes it.

    Attributes:
        eye: metres; relative to the followed link in x and y.
        target: metres, likewise; the point looked at.
        fovy: vertical field of view, degrees.
        link: index of the followed link, -1 for a camera at rest.
        up: the world direction that is up in the image.
    """

    eye: Vector
    target: Vector
    fovy: float
    link: int = -1
    up: Vector = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Task:
    """What there is to know about one task.

    Attributes:
        name: what ``make`` calls it; of Brax's tasks, what Brax does.
        gymnasium_id: what Gymnasium calls it.
        summary: one sentence: the goal, and what ends an episode before the time limit.
        default_backend: the physics backend used by default.
        camera: the default viewpoint; None for the model's own camera.
        original_camera: that of the paper, None where it has none.
        backends: those that simulate the task sanely, sorted.
        engine: folder of ``pixelbrax_jax.physics`` that simulates it.
        domain: name of the domain in the DM Control Suite, empty for Brax's tasks.
        task: name of the task there, likewise.
        colors: colors by geom name that replace the model's.
        drawn_radius: metres, spheres by name that are drawn larger than they are.
        paper_options: arguments of Brax's environment for the "paper" reward preset.
        paper_unscaled: whether that preset hands actions to costs and actuators as they are,
            where Brax first maps them from [-1, 1] to the control range. The actuators still clip
            to that range.
        paper_reward: name of that preset's reward in ``physics.brax.tasks``, None for Brax's.
    """

    name: str
    gymnasium_id: str
    summary: str
    default_backend: str
    camera: View | None
    original_camera: View | None
    backends: tuple[str, ...] = BRAX_BACKENDS
    engine: str = "brax"
    domain: str = ""
    task: str = ""
    colors: Mapping[str, Color] = field(default_factory=dict)
    drawn_radius: Mapping[str, float] = field(default_factory=dict)
    paper_options: Mapping[str, float] = field(default_factory=dict)
    paper_unscaled: bool = False
    paper_reward: str | None = None


# Viewpoints of the original renderer (arXiv 2502.00021). It gives a horizontal field of view; at
# its square images that is the vertical one too.
_ANT = View((1.6, -1.6, 3.5), (0.0, 0.0, 0.0), 40.0, link=0)
_PLANAR = View((0.0, -2.1, 0.8), (0.0, 0.0, 0.6), 55.0, link=0)
_HUMANOID = View((1.7, -1.7, 1.5), (0.0, 0.0, 1.1), 50.0, link=0)
_CART = View((0.0, -2.3, 0.0), (0.0, 0.0, 0.0), 55.0)
_PUSHER = View((1.6, 1.6, 0.75), (0.0, 0.0, 0.0), 50.0, link=0)
_REACHER = View((0.0, -0.01, 0.81), (0.0, 0.0, 0.0), 45.0, link=0, up=(0.0, 1.0, 1.0))
_SWIMMER = View((2.4, 2.4, 1.25), (0.0, 0.0, 0.0), 50.0, link=1)
# The original aims above the lying torso, which then sits at the lower edge.
_LYING = View((2.2, -2.2, 1.7), (0.0, 0.0, 0.55), 50.0, link=0)

# Default backends are those of the paper, which leaves the choice open for ant, humanoid and
# humanoidstandup and lacks the double pendulum.
_BRAX_ROWS = (
    Task(
        "ant",
        "PixelBrax/Ant-v0",
        "A four-legged body runs along x; ends when its torso is too low or too high.",
        "spring",
        _ANT,
        _ANT,
        # Brax's reset noise puts feet below the ground. The positional backend throws such an ant
        # into the air: a quarter of the episodes ends within four steps, whatever the action.
        backends=("generalized", "mjx", "spring"),
    ),
    Task(
        "halfcheetah",
        "PixelBrax/HalfCheetah-v0",
        "A planar two-legged body runs along x; never ends early.",
        "spring",
        _PLANAR,
        _PLANAR,
    ),
    Task(
        "hopper",
        "PixelBrax/Hopper-v0",
        "A planar one-legged body hops along x; ends when it falls.",
        "positional",
        _PLANAR,
        _PLANAR,
    ),
    Task(
        "humanoid",
        "PixelBrax/Humanoid-v0",
        "A humanoid runs along x; ends when its torso is too low or too high.",
        "spring",
        _HUMANOID,
        _HUMANOID,
        paper_unscaled=True,
    ),
    Task(
        "humanoidstandup",
        "PixelBrax/HumanoidStandup-v0",
        "A humanoid that lies on its back stands up; never ends early.",
        "spring",
        _LYING,
        _HUMANOID,
        paper_unscaled=True,
    ),
    Task(
        "inverted_double_pendulum",
        "PixelBrax/InvertedDoublePendulum-v0",
        "A cart balances two poles in a row; ends when the tip sinks to 1 m.",
        "generalized",
        View((0.0, -3.0, 0.6), (0.0, 0.0, 0.6), 55.0),
        None,
    ),
    Task(
        "inverted_pendulum",
        "PixelBrax/InvertedPendulum-v0",
        "A cart balances a pole; ends when it tilts by more than 0.2 rad.",
        "generalized",
        _CART,
        _CART,
        paper_unscaled=True,
    ),
    # The paper's pusher also has another object; its physics are not reproduced.
    Task(
        "pusher",
        "PixelBrax/Pusher-v0",
        "A robot arm pushes a cylinder to a goal; never ends early.",
        "generalized",
        _PUSHER,
        _PUSHER,
        # The goal disc has no name in Brax's model, only its place in the list.
        colors={"object_geom": _SKY_BLUE, "capsule/20": _VERMILLION},
        paper_unscaled=True,
    ),
    Task(
        "reacher",
        "PixelBrax/Reacher-v0",
        "A planar arm of two joints reaches for a target; never ends early.",
        "generalized",
        _REACHER,
        _REACHER,
        colors={"fingertip": _YELLOW, "target": _RED},
        # At 84 pixels their 9 and 10 mm are two pixels.
        drawn_radius={"fingertip": 0.015, "target": 0.018},
    ),
    Task(
        "swimmer",
        "PixelBrax/Swimmer-v0",
        "A planar chain of three links swims along x; never ends early.",
        "generalized",
        _SWIMMER,
        _SWIMMER,
        # Brax itself refuses the swimmer on other backends.
        backends=("generalized",),
        paper_reward="distance_swum",
    ),
    Task(
        "walker2d",
        "PixelBrax/Walker2d-v0",
        "A planar two-legged body walks along x; ends when it falls.",
        "spring",
        _PLANAR,
        _PLANAR,
        paper_options={"forward_reward_weight": 10.0},
    ),
)


def _dmc(domain: str, task: str, summary: str) -> Task:
    """Return the row of a task of the DM Control Suite."""
    words = [*domain.split("_"), *task.split("_")]
    return Task(
        f"dmc_{domain}_{task}",
        f"PixelBrax/DMC-{''.join(word[:1].upper() + word[1:] for word in words)}-v0",
        summary,
        "mjx",
        camera=None,
        original_camera=None,
        backends=("mjx",),
        engine="mjx",
        domain=domain,
        task=task,
    )


# None of them ends before the time limit.
_DMC_ROWS = (
    _dmc("acrobot", "swingup", "Two poles in a row swing up, moved at the elbow."),
    _dmc("acrobot", "swingup_sparse", "The same, rewarded at the target alone."),
    _dmc("ball_in_cup", "catch", "A cup on springs catches a ball on a string."),
    _dmc("cartpole", "balance", "A cart balances a pole that begins upright."),
    _dmc("cartpole", "balance_sparse", "The same, rewarded near upright alone."),
    _dmc("cartpole", "swingup", "A cart swings up a pole and balances it."),
    _dmc("cartpole", "swingup_sparse", "The same, rewarded near upright alone."),
    _dmc("cheetah", "run", "A planar two-legged body runs along x."),
    _dmc("finger", "spin", "A finger spins a body on a hinge."),
    _dmc("finger", "turn_easy", "A finger turns a body's tip into a large target."),
    _dmc("finger", "turn_hard", "A finger turns a body's tip into a small target."),
    _dmc("fish", "upright", "A fish rights itself."),
    _dmc("fish", "swim", "A fish swims to a target."),
    _dmc("hopper", "stand", "A planar one-legged body stands up."),
    _dmc("hopper", "hop", "A planar one-legged body hops along x."),
    _dmc("humanoid", "stand", "A humanoid stands still."),
    _dmc("humanoid", "walk", "A humanoid walks in any direction."),
    _dmc("humanoid", "run", "A humanoid runs in any direction."),
    _dmc("manipulator", "bring_ball", "An arm with two fingers brings a ball to a target."),
    _dmc("pendulum", "swingup", "A pendulum swings up, rewarded near upright alone."),
    _dmc("point_mass", "easy", "A point is pushed to the middle of an arena."),
    _dmc("quadruped", "walk", "A four-legged body walks forward."),
    _dmc("quadruped", "run", "A four-legged body runs forward."),
    _dmc("reacher", "easy", "A planar arm reaches for a large target."),
    _dmc("reacher", "hard", "A planar arm reaches for a small target."),
    _dmc("swimmer", "swimmer6", "A planar chain of six bodies swims to a target."),
    _dmc("swimmer", "swimmer15", "A planar chain of fifteen bodies swims to a target."),
    _dmc("walker", "stand", "A planar two-legged body stands up."),
    _dmc("walker", "walk", "A planar two-legged body walks along x."),
    _dmc("walker", "run", "A planar two-legged body runs along x."),
)


def _table(rows: tuple[Task, ...]) -> Mapping[str, Task]:
    return MappingProxyType({row.name: row for row in rows})


BRAX_TASKS = _table(_BRAX_ROWS)
"""Brax's tasks by name."""

DMC_TASKS = _table(_DMC_ROWS)
"""Tasks of the DM Control Suite by name."""

TASKS = _table((*_BRAX_ROWS, *_DMC_ROWS))
"""All built-in tasks by name."""

SUITES: Mapping[str, Mapping[str, Task]] = MappingProxyType({"brax": BRAX_TASKS, "dmc": DMC_TASKS})
"""The built-in tasks of each suite."""
