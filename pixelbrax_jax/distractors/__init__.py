"""What an agent must learn to ignore: changes of color, background and viewpoint."""

from pixelbrax_jax.distractors.base import Distractor as Distractor
from pixelbrax_jax.distractors.camera import MovingCamera as MovingCamera
from pixelbrax_jax.distractors.clips import ClipBank as ClipBank
from pixelbrax_jax.distractors.clips import OnlySplitWarning as OnlySplitWarning
from pixelbrax_jax.distractors.clips import ProceduralClipsWarning as ProceduralClipsWarning
from pixelbrax_jax.distractors.clips import load_clips as load_clips
from pixelbrax_jax.distractors.color import Color as Color
from pixelbrax_jax.distractors.presets import PRESETS as PRESETS
from pixelbrax_jax.distractors.presets import preset as preset
from pixelbrax_jax.distractors.video import Video as Video
