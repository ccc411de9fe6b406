"""Videos in the background or over the whole image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax.distractors.base import Distractor, levels
from pixelbrax_jax.types import FAR, Clips, EnvParams, Frame
from pixelbrax_jax.validation import check_bool, check_choice, check_fraction, check_positive_int

MODES = ("overlay", "background")
DYNAMICS = ("pingpong", "loop", "static")


class VideoState(struct.PyTreeNode):
    """State of the video.

    Attributes:
        clip: () int32, index of the clip.
        start: () int32, its frame at the start of the episode.
        direction: () int32, +1 or -1.
        frame: () int32, its current frame.
    """

    clip: jax.Array
    start: jax.Array
    direction: jax.Array
    frame: jax.Array


@dataclass(frozen=True)
class Video(Distractor):
    """Plays a clip of ``EnvParams.clips``, one of its frames for each frame of the episode.

    With v the video's pixel and a = ``alpha``:

    * ``mode="overlay"``: every pixel p becomes ``(1 - a) p + a v``.
    * ``mode="background"``: the sky s becomes ``(1 - a) s + a v``, the ground g becomes
      ``g ground_alpha + (1 - ground_alpha) v``; all other pixels keep their bits.

    Clip, first frame and direction are sampled at an episode reset. At frame t of the episode a
    clip of L frames that started at s in direction d shows

    * ``"loop"``: frame ``(s + d t) mod L``,
    * ``"pingpong"``: with ``P = 2 (L - 1)`` and ``q = (s + d t) mod P``, frame ``min(q, P - q)``,
    * ``"static"``: frame s.

    Sources: an overlay with a = 0.5 is from the paper, arXiv 2502.00021; pingpong backgrounds are
    from the Distracting Control Suite, arXiv 2101.02722; loops in the sky, or in sky and ground,
    are video-easy and video-hard of the DMControl Generalization Benchmark, arXiv 2011.13389.

    Attributes:
        mode: ``"overlay"`` or ``"background"``.
        alpha: fraction of the video, in [0, 1]; None means 0.5 for an overlay, 1 for a background.
        ground_alpha: fraction of the ground that is kept, in [0, 1]; only with a background.
        dynamics: ``"pingpong"``, ``"loop"`` or ``"static"``.
        num_clips: number of the split's clips to use, from the first; None means all.
        random_start: whether the first frame is sampled; else it is the clip's first.

    Raises:
        ValueError: an option is unknown or out of range; the message says what is allowed.
        TypeError: ``random_start`` is no bool.
    """

    mode: str = "background"
    alpha: float | None = None
    ground_alpha: float = 1.0
    dynamics: str = "pingpong"
    num_clips: int | None = None
    random_start: bool = True

    kind: ClassVar[str] = "video"
    stream: ClassVar[int] = 2
    only_colors: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_choice("mode of Video", self.mode, MODES)
        check_choice("dynamics of Video", self.dynamics, DYNAMICS)
        check_fraction("alpha of Video", self.fraction)
        check_fraction("ground_alpha of Video", self.ground_alpha)
        check_bool("random_start of Video", self.random_start)
        if self.mode == "overlay" and self.ground_alpha != 1.0:
            raise ValueError("ground_alpha of Video is only for mode='background'.")
        if self.num_clips is not None:
            check_positive_int("num_clips of Video", self.num_clips)

    @property
    def fraction(self) -> float:
        """Weight of the video, in [0, 1]."""
        if self.alpha is not None:
            return self.alpha
        return 0.5 if self.mode == "overlay" else 1.0

    def reset(self, key: jax.Array, params: EnvParams) -> VideoState:
        """Sample a clip, its first frame and its direction."""
        clips = _clips(params)
        clip_key, start_key, direction_key = jax.random.split(key, 3)
        count = clips.length.shape[0]
        count = count if self.num_clips is None else min(count, self.num_clips)
        clip = jax.random.randint(clip_key, (), 0, count)
        start = jax.random.randint(start_key, (), 0, jnp.asarray(clips.length)[clip])
        backward = jax.random.bernoulli(direction_key)
        return VideoState(
            clip=clip,
            start=start if self.random_start else jnp.zeros_like(start),
            direction=jnp.where(backward & (self.dynamics == "pingpong"), -1, 1),
            frame=start if self.random_start else jnp.zeros_like(start),
        )

    def advance(
        self, state: VideoState, key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> VideoState:
        """Return the state with the clip's next frame."""
        length = jnp.asarray(_clips(params).length)[state.clip]
        return state.replace(
            frame=frame_index(self.dynamics, length, state.start, state.direction, frame)
        )

    def backdrop(
        self, state: VideoState, params: EnvParams, rows: jax.Array, height: int, width: int
    ) -> jax.Array:
        """Return rows of the clip's frame, with nearest pixels if the image has another size."""
        clips = _clips(params)
        index = jnp.asarray(clips.first)[state.clip] + state.frame
        packed = jnp.asarray(clips.packed)
        _, present_height, present_width = packed.shape
        if present_height != height:
            rows = (2 * rows + 1) * present_height // (2 * height)
        image = packed[index, rows]
        if present_width == width:
            return image
        return image[:, (2 * np.arange(width) + 1) * present_width // (2 * width)]

    def change_frame(self, state: VideoState, frame: Frame, backdrop: jax.Array | None) -> Frame:
        """Return the frame blended with the video."""
        assert backdrop is not None
        kept: float | jax.Array = 1.0 - self.fraction
        if self.mode == "background":
            kept = jnp.where(frame.depth == FAR, kept, 1.0)
            if self.ground_alpha != 1.0:
                kept = jnp.where(frame.ground, self.ground_alpha, kept)
        # For a pixel that is kept the video's fraction is exactly 0, so it keeps its bits.
        added = (1.0 - kept) * (1.0 / 255.0)
        r, g, b = (
            kept * plane + added * level
            for plane, level in zip((frame.r, frame.g, frame.b), levels(backdrop), strict=True)
        )
        return frame.replace(r=r, g=g, b=b)

    def info(self, state: VideoState) -> dict[str, jax.Array]:
        """Return ``video_clip`` and ``video_frame``, the indices of clip and frame."""
        return {"video_clip": state.clip, "video_frame": state.frame}


def frame_index(
    dynamics: str,
    length: jax.Array | int,
    start: jax.Array | int,
    direction: jax.Array | int,
    frame: jax.Array | int,
) -> jax.Array:
    """Return the clip's frame at frame ``frame`` of the episode, () int32; see ``Video``."""
    first = jnp.asarray(start, jnp.int32)
    if dynamics == "static":
        return first
    place = first + direction * jnp.asarray(frame, jnp.int32)
    if dynamics == "loop":
        return jnp.mod(place, length)
    # For a clip of one frame the period is 1.
    period = jnp.maximum(2 * (jnp.int32(length) - 1), 1)
    there = jnp.mod(place, period)
    return jnp.asarray(jnp.where(jnp.int32(length) > 1, jnp.minimum(there, period - there), 0))


def _clips(params: EnvParams) -> Clips:
    if params.clips is None:
        raise ValueError(
            "a Video needs clips: pass clips= to pixelbrax_jax.make, or set EnvParams.clips to "
            "load_clips(...).to_device()."
        )
    return params.clips
