"""Tasks of the DM Control Suite, one row each. Importing it loads no physics."""

from __future__ import annotations

from dataclasses import dataclass

from pixelbrax_jax.physics.task import Task, by_name


@dataclass(frozen=True, eq=False)
class DmcTask(Task):
    """A task of the DM Control Suite.

    Attributes:
        domain: the suite's name of the domain.
        task: the suite's name of the task.
    """

    domain: str
    task: str


def _dmc(domain: str, task: str, summary: str) -> DmcTask:
    name = f"{domain}_{task}"
    camel = "".join(word[:1].upper() + word[1:] for word in name.split("_"))
    # A step's reward is at most 1, and an episode has 1,000 steps.
    return DmcTask(
        f"dmc_{name}",
        f"PixelBrax/DMC-{camel}-v0",
        summary,
        domain,
        task,
        success_return=500.0,
        other_names=(f"dmc_{name}", name, task),
    )


# All of them last until the time limit.
TASKS = by_name(
    [
        _dmc("acrobot", "swingup", "Two poles in a row swing up, moved at the elbow."),
        _dmc("acrobot", "swingup_sparse", "The same, rewarded only at the target."),
        _dmc("ball_in_cup", "catch", "A cup on springs catches a ball on a string."),
        _dmc("cartpole", "balance", "A cart balances a pole that begins upright."),
        _dmc("cartpole", "balance_sparse", "The same, rewarded only near upright."),
        _dmc("cartpole", "swingup", "A cart swings up a pole and balances it."),
        _dmc("cartpole", "swingup_sparse", "The same, rewarded only near upright."),
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
        _dmc("pendulum", "swingup", "A pendulum swings up, rewarded only near upright."),
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
    ]
)
"""Tasks of the DM Control Suite by name."""
