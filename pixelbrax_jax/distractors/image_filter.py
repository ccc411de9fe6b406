"""Blur, contrast and noise of the image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax._platform.by_platform import computed_once
from pixelbrax_jax.distractors.base import Distractor, levels
from pixelbrax_jax.types import EnvParams, Frame
from pixelbrax_jax.validation import check_finite, check_fraction


@dataclass(frozen=True)
class ImageFilter(Distractor):
    """Blurs the image, changes contrast, and adds noise to every pixel and channel, in this order.

    Blurred colors are means with the weights ``exp(-d^2 / (2 s^2))`` of pixels at distances d up to
    3 s along each axis, where s is ``blur`` times the image's height; beyond the border, pixels are
    those of the border. A color c then becomes ``1/2 + contrast (c - 1/2) + u``, clipped to [0, 1],
    where u is uniform on [-noise, noise] and new in every frame.

    Attributes:
        blur: standard deviation of the blur in heights of the image, in [0, 0.1].
        contrast: factor in [0, 1] of the distance from mid grey.
        noise: size of the noise, in units of the color range [0, 1].

    Raises:
        ValueError: an option is out of range.
    """

    blur: float = 0.0
    contrast: float = 1.0
    noise: float = 0.0

    kind: ClassVar[str] = "filter"
    stream: ClassVar[int] = 4
    only_colors: ClassVar[bool] = True

    @property
    def whole_image(self) -> bool:
        """Whether it blurs: a pixel then depends on other rows."""
        return self.blur > 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= check_finite("blur of ImageFilter", self.blur) <= 0.1:
            raise ValueError(f"blur of ImageFilter must lie in [0, 0.1], got {self.blur}.")
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
        """Return the frame, blurred, with other contrast and noise."""
        planes = [frame.r, frame.g, frame.b]
        if self.blur:
            like = [jax.ShapeDtypeStruct(plane.shape, plane.dtype) for plane in planes]
            planes = computed_once(lambda planes: planes, (planes,), like)
            planes = [_blurred(plane, self.blur) for plane in planes]
        planes = [0.5 + self.contrast * (plane - 0.5) for plane in planes]
        if backdrop is not None:
            planes = [
                plane + self.noise * (level * (2.0 / 255.0) - 1.0)
                for plane, level in zip(planes, levels(backdrop), strict=True)
            ]
        r, g, b = (jnp.clip(plane, 0.0, 1.0) for plane in planes)
        return frame.replace(r=r, g=g, b=b)


def _blurred(plane: jax.Array, blur: float) -> jax.Array:
    """Return the (H, W) image, blurred along columns and then along rows."""
    scale = blur * plane.shape[0]
    reach = math.ceil(3.0 * scale)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / scale) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (0, 1):
        size = plane.shape[axis]
        widths = [(reach, reach) if a == axis else (0, 0) for a in (0, 1)]
        padded = jnp.pad(plane, widths, mode="edge")
        shifted = [
            jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(len(weights))
        ]
        plane = sum((w * x for w, x in zip(weights, shifted, strict=True)), jnp.zeros(()))
    return plane
