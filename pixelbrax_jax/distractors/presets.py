"""Presets: distractors of published benchmarks, and of one axis alone."""

from __future__ import annotations

from collections.abc import Iterable

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.camera import MovingCamera
from pixelbrax_jax.distractors.color import Color
from pixelbrax_jax.distractors.image_filter import ImageFilter
from pixelbrax_jax.distractors.light import Light
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.validation import check_choice

_SCALES = {"easy": 0.1, "medium": 0.2, "hard": 0.3}
NUM_CLIPS = {"easy": 4, "medium": 8, "hard": None}

_GROUND_ALPHA = {
    "reacher": 0.0,
    "walker2d": 1.0,
    "halfcheetah": 1.0,
    "hopper": 1.0,
    "dmc_reacher": 0.0,
    "dmc_walker": 1.0,
    "dmc_cheetah": 1.0,
}
"""The Distracting Control Suite's values, by domain for DM Control's tasks; others keep 0.3."""

_FIXED: dict[str, tuple[Distractor, ...]] = {
    "color": (Color(),),
    "video": (Video(),),
    "camera": (MovingCamera(),),
    "light": (Light(),),
    "paper-color": (Color(mode="frame", dynamics="iid", scale=0.3, distribution="normal"),),
    "paper-video": (Video(mode="overlay", alpha=0.5, dynamics="loop"),),
    "video-easy": (Video(ground_alpha=1.0, dynamics="loop", num_clips=10, random_start=False),),
    "video-hard": (Video(ground_alpha=0.0, dynamics="loop", num_clips=100, random_start=False),),
}

# DM Control's materials of robot and ground.
_DMC = ("self", "grid")
_FIXED |= {
    f"color-{level}": (Color("geom", "static", scale, "normal", sky=True, materials=_DMC),)
    for level, scale in (("easy", 0.1), ("hard", 0.2))
}

# What each axis of the suite ``axes`` changes, at its middle size.
_FIXED |= {
    f"axis-{axis}": (link,)
    for axis, link in {
        "background": Video(ground_alpha=1.0, dynamics="loop", random_start=False),
        "palette": Color("geom", "static", 0.2, sky=True),
        "body-color": Color("geom", "static", 0.2, ground=False),
        "light-direction": Light(40.0, intensity=0.0, color=0.0),
        "light-intensity": Light(0.0, intensity=0.4, color=0.0),
        "light-color": Light(0.0, intensity=0.0, color=0.4),
        "camera": MovingCamera(0.2, dynamic=False),
        "blur": ImageFilter(blur=0.02),
        "contrast": ImageFilter(contrast=0.5),
        "noise": ImageFilter(noise=0.1),
        "tint": Color("frame", "static", 0.2),
    }.items()
}

PRESETS = (
    *_FIXED,
    *(f"dcs-{level}{suffix}" for level in _SCALES for suffix in ("", "-static")),
)


def preset(name: str, task: str) -> tuple[Distractor, ...]:
    """Return the distractors of a benchmark, one of ``PRESETS``; others raise ValueError.

    * ``"color"``, ``"video"``, ``"camera"``, ``"light"``: each with its defaults.
    * ``"paper-color"``, ``"paper-video"``: those of the paper, arXiv 2502.00021.
    * ``"dcs-easy"``, ``"dcs-medium"``, ``"dcs-hard"``, and each with ``"-static"``: color, video
      and camera of the Distracting Control Suite, arXiv 2101.02722. The task decides how much of
      the ground the video covers.
    * ``"color-easy"``, ``"color-hard"``, ``"video-easy"``, ``"video-hard"``: of the DMControl
      Generalization Benchmark, arXiv 2011.13389; colors are sampled, see ``Color``.
    * ``"axis-..."``: ``background``, ``palette``, ``body-color``, ``light-direction``,
      ``light-intensity``, ``light-color``, ``camera``, ``blur``, ``contrast``, ``noise`` or
      ``tint`` alone, to train for that axis of the suite ``axes``.
    """
    check_choice("distractor", name, PRESETS)
    if name in _FIXED:
        return _FIXED[name]
    _, level, *rest = name.split("-")
    dynamic = not rest
    scale = _SCALES[level]
    return (
        MovingCamera(scale=scale, dynamic=dynamic),
        Video(
            ground_alpha=_ground_alpha(task),
            dynamics="pingpong" if dynamic else "static",
            num_clips=NUM_CLIPS[level],
        ),
        Color(
            mode="geom",
            dynamics="walk" if dynamic else "static",
            scale=scale,
            distribution="uniform",
            ground=dcs_ground(task),
        ),
    )


def dcs_ground(task: str) -> bool | str:
    """Return how DCS changes the ground: in DM Control its material is white, with a texture."""
    return "texture" if task.startswith("dmc_") else True


def _ground_alpha(task: str) -> float:
    """Return the fraction of the ground that DCS keeps; for DM Control's tasks by domain."""
    for name, alpha in _GROUND_ALPHA.items():
        if task == name or (name.startswith("dmc_") and task.startswith(f"{name}_")):
            return alpha
    return 0.3


def as_tuple(
    distractors: str | Distractor | Iterable[str | Distractor] | None,
) -> tuple[str | Distractor, ...]:
    """Return distractors or names as a tuple; raise TypeError for anything else."""
    if distractors is None:
        return ()
    if not isinstance(distractors, (str, Distractor, Iterable)):
        raise TypeError(
            f"distractors must be a name, a Distractor or several of them, got {distractors!r}; "
            f"names: {', '.join(PRESETS)}."
        )
    given = (distractors,) if isinstance(distractors, (str, Distractor)) else tuple(distractors)
    for item in given:
        if not isinstance(item, (str, Distractor)):
            raise TypeError(
                f"a distractor is a name or a Distractor, got {type(item).__name__}; names: "
                f"{', '.join(PRESETS)}."
            )
    return given


def resolve(
    distractors: str | Distractor | Iterable[str | Distractor] | None, task: str
) -> tuple[Distractor, ...]:
    """Return distractors, with presets for the task in place of names; errors as in ``preset``."""
    resolved: list[Distractor] = []
    for item in as_tuple(distractors):
        resolved += preset(item, task) if isinstance(item, str) else [item]
    return tuple(resolved)
