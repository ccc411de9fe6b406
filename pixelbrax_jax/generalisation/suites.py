"""The levels of each suite, a row for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.camera import MovingCamera
from pixelbrax_jax.distractors.color import Color
from pixelbrax_jax.distractors.image_filter import ImageFilter
from pixelbrax_jax.distractors.presets import NUM_CLIPS, dcs_ground, preset
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.generalisation.changes import (
    BodyColor,
    Change,
    LightColor,
    LightDirection,
    LightIntensity,
    Radius,
    Rotation,
    Shift,
)
from pixelbrax_jax.validation import check_choice

EPISODES = 1_000_003
"""Seed of the evaluated episodes, whatever the seed of the training."""


@dataclass(frozen=True)
class Level:
    """One test of a suite: the task with some changes.

    Attributes:
        name: unique in its suite.
        changes: distractors and changes of parameters, in this order.
        clips: splits of the clips; the first existing one is used; empty without video.
        num_clips: number of clips, from the first; None for all.
        in_order: whether episode i shows clip i modulo their number; else clips are sampled.
    """

    name: str
    changes: tuple[Change | Distractor, ...] = ()
    clips: tuple[str, ...] = ()
    num_clips: int | None = None
    in_order: bool = False


@dataclass(frozen=True)
class Suite:
    """A suite: levels of a task, the first of them clean, and default number of episodes of each.

    ``source`` says where its levels are from; ``levels`` raises a ValueError if a task has none.
    """

    levels: Callable[[str], tuple[Level, ...]]
    episodes: int
    source: str


CLEAN = Level("clean")

_VIDEO_EASY = Video(ground_alpha=1.0, dynamics="loop", random_start=False)
_VIDEO_HARD = replace(_VIDEO_EASY, ground_alpha=0.0)
_EASY_CLIPS, _HARD_CLIPS = ("video_easy", "test"), ("video_hard", "test")

_INTENSITIES = {
    0.025: 2,
    0.05: 2,
    0.1: 4,
    0.15: 6,
    0.2: 8,
    0.3: None,
    0.4: None,
    0.5: None,
}
"""Number of clips of each intensity of DMControl-GB's distracting levels."""

_CORNERS = {
    "dmc_walker": Shift(y=(-10.0, 10.0), x=(-10.0, 10.0)),
    "dmc_cheetah": Shift(y=(-10.0, 10.0), x=(-10.0, 10.0)),
    "dmc_cartpole": Shift(y=(-8.0, 8.0), x=(-10.0, 10.0)),
    "dmc_finger": Shift(y=(-6.0, 6.0), x=(-6.0, 12.0)),
    "dmc_ball_in_cup": Shift(y=(-6.0, 6.0), x=(-6.0, 12.0)),
}
"""DMC-GB2's hard shifts by domain; the easy ones are smaller by 1.5."""

_SUBTLE = {
    "dmc_ball_in_cup_catch": Radius(1 / 12, ("ball", "tendon/string")),
    "dmc_cartpole_swingup": Radius(1 / 20, ("pole",)),
    "dmc_finger_turn_hard": Radius(1 / 2, ("site/target",)),
    "dmc_point_mass_easy": Radius(1 / 6, ("target", "pointmass")),
    "dmc_reacher_hard": Radius(1 / 3, ("target",)),
}


_OTHERS = "The suites axes, dcs and paper have levels for any task."


def _video(name: str, hard: bool, ground: bool, *others: Change | Distractor) -> Level:
    video = _VIDEO_EASY if ground else _VIDEO_HARD
    clips, num = (_HARD_CLIPS, 100) if hard else (_EASY_CLIPS, 10)
    return Level(name, (*others, video), clips, num, in_order=True)


def _dmcgb(task: str) -> tuple[Level, ...]:
    return (
        CLEAN,
        Level("color-easy", preset("color-easy", task)),
        Level("color-hard", preset("color-hard", task)),
        _video("video-easy", hard=False, ground=True),
        _video("video-hard", hard=True, ground=False),
        *(
            Level(f"distracting-{scale}", _distracting(task, scale), ("train",), num_clips)
            for scale, num_clips in _INTENSITIES.items()
        ),
    )


def _distracting(task: str, scale: float) -> tuple[Distractor, ...]:
    """Return the Distracting Control Suite's dynamic distractors at another scale."""
    videos = [link for link in preset("dcs-easy", task) if isinstance(link, Video)]
    color = Color("geom", "walk", scale, "uniform", ground=dcs_ground(task))
    return MovingCamera(scale), *_of_all_clips(videos), color


def _of_all_clips(links: Iterable[Distractor]) -> tuple[Distractor, ...]:
    """Return distractors whose videos may show all clips; the level sets their number."""
    return tuple(
        replace(link, num_clips=None) if isinstance(link, Video) else link for link in links
    )


def _dmcgb2(task: str) -> tuple[Level, ...]:
    domain = next((name for name in _CORNERS if task.startswith(f"{name}_")), None)
    if domain is None:
        raise ValueError(
            f"suite 'dmcgb2' has no levels for task {task!r}, only for tasks of "
            f"{', '.join(_CORNERS)}, whose shifts of the camera it defines. {_OTHERS}"
        )
    hard_shift = _CORNERS[domain]
    levels = [CLEAN]
    for name in ("easy", "hard"):
        hard = name == "hard"
        rotation = Rotation(180.0 if hard else 90.0)
        shift = hard_shift if hard else _divided(hard_shift, 1.5)
        palette = preset(f"color-{name}", task)
        levels += [
            Level(f"color-{name}", palette),
            _video(f"video-{name}", hard, ground=not hard),
            # The ground stays at both levels, as in the benchmark's code.
            _video(f"color-video-{name}", hard, True, *palette),
            Level(f"rotate-{name}", (rotation,)),
            Level(f"shift-{name}", (shift,)),
            Level(f"rotate-shift-{name}", (shift, rotation)),
        ]
    return tuple(levels)


def _divided(shift: Shift, by: float) -> Shift:
    (left, right), (low, high) = shift.y, shift.x
    return Shift(y=(left / by, right / by), x=(low / by, high / by))


def _dcs(task: str) -> tuple[Level, ...]:
    def levels() -> Iterator[Level]:
        for difficulty, num_clips in NUM_CLIPS.items():
            for suffix in ("", "-static"):
                links = _of_all_clips(preset(f"dcs-{difficulty}{suffix}", task))
                for split in ("train", "test"):
                    name = f"{difficulty}{suffix or '-dynamic'}-{split}"
                    yield Level(name, links, (split,), num_clips)

    return (CLEAN, *levels())


def _paper(task: str) -> tuple[Level, ...]:
    return (
        CLEAN,
        Level("color", preset("paper-color", task)),
        Level("video", preset("paper-video", task), ("paper-test", "test")),
    )


def _subtle(task: str) -> tuple[Level, ...]:
    if task not in _SUBTLE:
        raise ValueError(
            f"suite 'subtle' has no levels for task {task!r}, only for {', '.join(_SUBTLE)}. "
            f"{_OTHERS}"
        )
    return CLEAN, Level("subtle", (_SUBTLE[task],))


def _axes(task: str) -> tuple[Level, ...]:
    background = (replace(_VIDEO_EASY, dynamics="static"), _VIDEO_EASY, _VIDEO_HARD)
    axes: dict[str, tuple[Change | Distractor, ...]] = {
        "palette": tuple(Color("geom", "static", b, sky=True) for b in (0.1, 0.2, 0.3)),
        "body-color": tuple(BodyColor(b) for b in (0.1, 0.2, 0.3)),
        "light-direction": tuple(LightDirection(angle) for angle in (20.0, 40.0, 60.0)),
        "light-intensity": tuple(LightIntensity(amount) for amount in (0.2, 0.4, 0.6)),
        "light-color": tuple(LightColor(amount) for amount in (0.2, 0.4, 0.6)),
        "camera": tuple(MovingCamera(b, dynamic=False) for b in (0.1, 0.2, 0.3)),
        "blur": tuple(ImageFilter(blur=size) for size in (0.01, 0.02, 0.04)),
        "contrast": tuple(ImageFilter(contrast=factor) for factor in (0.75, 0.5, 0.25)),
        "noise": tuple(ImageFilter(noise=size) for size in (0.05, 0.1, 0.2)),
        "tint": tuple(Color("frame", "static", b) for b in (0.1, 0.2, 0.3)),
    }
    return (
        CLEAN,
        *(
            Level(f"background-{number}", (video,), ("test",), in_order=True)
            for number, video in enumerate(background, 1)
        ),
        *(
            Level(f"{axis}-{number}", (change,))
            for axis, changes in axes.items()
            for number, change in enumerate(changes, 1)
        ),
    )


SUITES = {
    "dmcgb": Suite(_dmcgb, 30, "DMControl Generalization Benchmark, arXiv 2011.13389"),
    "dmcgb2": Suite(_dmcgb2, 100, "DMC-GB2, arXiv 2405.17416"),
    "dcs": Suite(_dcs, 100, "Distracting Control Suite, arXiv 2101.02722"),
    "paper": Suite(_paper, 100, "PixelBrax, arXiv 2502.00021"),
    "subtle": Suite(_subtle, 100, "DMC-Subtle"),
    "axes": Suite(_axes, 100, "one axis changed at a time"),
}


def levels_of(suite: str, task: str) -> tuple[Level, ...]:
    """Return the levels of a suite for a task, the first of them clean."""
    return SUITES[check_choice("suite", suite, SUITES)].levels(task)
