"""Distractors: changes of color, background and camera that an agent must ignore."""

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.camera import MovingCamera
from pixelbrax_jax.distractors.clips import (
    ClipBank,
    OnlySplitWarning,
    ProceduralClipsWarning,
    load_clips,
)
from pixelbrax_jax.distractors.color import Color
from pixelbrax_jax.distractors.image_filter import ImageFilter
from pixelbrax_jax.distractors.light import Light
from pixelbrax_jax.distractors.presets import PRESETS, preset
from pixelbrax_jax.distractors.video import Video

__all__ = [
    "PRESETS",
    "ClipBank",
    "Color",
    "Distractor",
    "ImageFilter",
    "Light",
    "MovingCamera",
    "OnlySplitWarning",
    "ProceduralClipsWarning",
    "Video",
    "load_clips",
    "preset",
]
