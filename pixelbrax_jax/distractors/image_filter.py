"""Contrast and noise of the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.distractors.base import Distractor, levels
from pixelbrax_jax.types import EnvParams, Frame
from pixelbrax_jax.validation import check_fraction


@dataclass(frozen=True)
class ImageFilter(Distractor):
    """Changes contrast, and adds noise to every pixel and channel.

    A color c becomes ``1/2 + contrast (c - 1/2) + u``, clipped to [0, 1], where u is uniform on
    [-noise, noise] and new in every frame.

    Attributes:
        contrast: factor in [0, 1] of the distance from mid grey.
        noise: size of the noise, in units of the color range [0, 1].

    Raises:
        ValueError: an option is out of range.
    """

    contrast: float = 1.0
    noise: float = 0.0

    kind: ClassVar[str] = "filter"
    stream: ClassVar[int] = 4

    def __post_init__(self) -> None:
        check_fraction("contrast of ImageFilter", self.contrast)
        check_fraction("noise of ImageFilter", self.noise)

    def reset(self, key: jax.Array, params: EnvParams) -> jax.Array:
        """Sample () uint32, the seed of the frame's noise."""
        return jax.random.bits(key)

    def advance(
        self, state: jax.Array, key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> jax.Array:
        """Sample the seed of the next frame's noise."""
        return jax.random.bits(key)

    def backdrop(
        self, state: jax.Array, params: EnvParams, rows: jax.Array, height: int, width: int
    ) -> jax.Array | None:
        """Return random pixels, or none without noise."""
        if not self.noise:
            return None
        key = jax.random.key(state)
        return jax.vmap(lambda row: jax.random.bits(jax.random.fold_in(key, row), (width,)))(rows)

    def change_frame(self, state: jax.Array, frame: Frame, backdrop: jax.Array | None) -> Frame:
        """Return the frame with other contrast and noise."""
        planes = [0.5 + self.contrast * (plane - 0.5) for plane in (frame.r, frame.g, frame.b)]
        if backdrop is not None:
            planes = [
                plane + self.noise * (level * (2.0 / 255.0) - 1.0)
                for plane, level in zip(planes, levels(backdrop), strict=True)
            ]
        r, g, b = (jnp.clip(plane, 0.0, 1.0) for plane in planes)
        return frame.replace(r=r, g=g, b=b)
