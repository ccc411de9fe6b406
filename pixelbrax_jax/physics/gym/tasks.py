"""Gymnasium's MuJoCo tasks, one row each. Importing it loads no physics."""

from __future__ import annotations

from dataclasses import dataclass

from pixelbrax_jax.physics.task import Task, by_name


@dataclass(frozen=True, eq=False)
class GymTask(Task):
    """A task of Gymnasium's.

    Attributes:
        original: Gymnasium's id.
        model: file with the model, in Gymnasium's folder.
        lookat: metres, the point that Gymnasium's camera looks at; None for the median of the
            model's geoms.
        distance: metres from there to the camera; None for the model's extent.
        elevation: degrees of the camera's view above the horizon.
        time_limit: control steps of an episode.
    """

    original: str
    model: str
    lookat: tuple[float, float, float] | None = None
    distance: float | None = None
    elevation: float = -45.0
    time_limit: int = 1000


def _gym(name: str, original: str, model: str, summary: str, **options: object) -> GymTask:
    return GymTask(
        f"gym_{name}",
        f"PixelBrax/Gym-{original}-v5",
        summary,
        f"{original}-v5",
        model,
        other_names=(f"{original}-v5",),
        **options,  # type: ignore[arg-type]
    )


# ``success_return`` is Gymnasium's ``reward_threshold``, but for the pusher: its 0 is out of reach,
# because all its rewards are negative.
TASKS = by_name(
    [
        _gym(
            "ant",
            "Ant",
            "ant.xml",
            "A four-legged body runs along x, until it falls or jumps.",
            success_return=6000.0,
            distance=4.0,
        ),
        _gym(
            "halfcheetah",
            "HalfCheetah",
            "half_cheetah.xml",
            "A planar two-legged body runs along x.",
            success_return=4800.0,
            distance=4.0,
        ),
        _gym(
            "hopper",
            "Hopper",
            "hopper.xml",
            "A planar one-legged body hops along x, until it falls.",
            success_return=3800.0,
            lookat=(0.0, 0.0, 1.15),
            distance=3.0,
            elevation=-20.0,
        ),
        _gym(
            "humanoid",
            "Humanoid",
            "humanoid.xml",
            "A humanoid runs along x, until it falls.",
            lookat=(0.0, 0.0, 2.0),
            distance=4.0,
            elevation=-20.0,
        ),
        _gym(
            "humanoidstandup",
            "HumanoidStandup",
            "humanoidstandup.xml",
            "A humanoid that lies stands up.",
            lookat=(0.0, 0.0, 0.8925),
            distance=4.0,
            elevation=-20.0,
        ),
        _gym(
            "inverted_double_pendulum",
            "InvertedDoublePendulum",
            "inverted_double_pendulum.xml",
            "A cart balances two poles in a row, until they fall.",
            success_return=9100.0,
        ),
        _gym(
            "inverted_pendulum",
            "InvertedPendulum",
            "inverted_pendulum.xml",
            "A cart balances a pole, until it falls.",
            success_return=950.0,
            distance=2.04,
        ),
        _gym(
            "pusher",
            "Pusher",
            "pusher_v5.xml",
            "An arm pushes a cylinder to a goal.",
            distance=4.0,
            time_limit=100,
        ),
        _gym(
            "reacher",
            "Reacher",
            "reacher.xml",
            "A planar arm reaches for a target.",
            success_return=-3.75,
            time_limit=50,
        ),
        _gym(
            "swimmer",
            "Swimmer",
            "swimmer.xml",
            "A planar chain of three bodies swims along x.",
            success_return=360.0,
        ),
        _gym(
            "walker2d",
            "Walker2d",
            "walker2d_v5.xml",
            "A planar two-legged body walks along x, until it falls.",
            lookat=(0.0, 0.0, 1.15),
            distance=4.0,
            elevation=-20.0,
        ),
    ]
)
"""Gymnasium's MuJoCo tasks by name."""
