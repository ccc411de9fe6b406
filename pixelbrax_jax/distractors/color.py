"""Colors that change: of the whole picture, or of each thing in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.choices import check_choice
from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.types import EnvParams, Frame, GeomKind

MODES = ("frame", "geom")
DYNAMICS = ("iid", "walk", "static")
DISTRIBUTIONS = ("normal", "uniform")

_WALK = 0.03
"""Standard deviation of a walk's step in units of the scale, of the Distracting Control Suite."""


@dataclass(frozen=True)
class Color(Distractor):
    """Shifts colors by random amounts of size ``scale``.

    ``mode="frame"`` adds one offset (red, green, blue) to every pixel and clips to [0, 1].
    ``mode="geom"`` gives every material a color of its own near the true one, clipped to
    [0, 1]; the ground shifts by what its material shifts by.

    An amount x is drawn from a normal distribution of standard deviation ``scale``, or from a
    uniform one on [-scale, scale], by ``dynamics``:

    * ``"static"``: once for each episode,
    * ``"iid"``: anew for each frame,
    * ``"walk"``: once for each episode, and then ``x += N(0, (0.03 scale)^2)`` for each frame,
      clipped to [-scale, scale].

    Sources: one normal offset for each frame, of standard deviation 0.3, is that of the paper,
    arXiv 2502.00021 (preset ``"paper-color"``). Materials on a walk are those of the Distracting
    Control Suite, arXiv 2101.02722, at scales 0.1, 0.2, 0.3.

    Attributes:
        mode: ``"frame"`` or ``"geom"``.
        dynamics: ``"iid"``, ``"walk"`` or ``"static"``.
        scale: size of the shift, in units of the color range [0, 1].
        distribution: ``"normal"`` or ``"uniform"``.
    """

    mode: str = "frame"
    dynamics: str = "iid"
    scale: float = 0.3
    distribution: str = "normal"

    kind: ClassVar[str] = "color"
    stream: ClassVar[int] = 1

    def __post_init__(self) -> None:
        """Checks the options.

        Raises:
            ValueError: an option is unknown or out of range; the message says what is allowed.
        """
        check_choice("mode of Color", self.mode, MODES)
        check_choice("dynamics of Color", self.dynamics, DYNAMICS)
        check_choice("distribution of Color", self.distribution, DISTRIBUTIONS)
        if not 0.0 <= self.scale <= 1.0:
            raise ValueError(f"scale of Color must lie in [0, 1], got {self.scale!r}.")

    def begin(self, key: jax.Array, params: EnvParams) -> jax.Array:
        """The shift: (3,) of the frame, or (M, 3) of the materials."""
        shape = (3,) if self.mode == "frame" else params.geoms.rgb.shape
        shift = self._draw(key, shape)
        # A walk starts inside the box that it stays in.
        shift = jnp.clip(shift, -self.scale, self.scale) if self.dynamics == "walk" else shift
        return self._within(shift, params)

    def advance(
        self, state: jax.Array, key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> jax.Array:
        """The next shift."""
        del frame
        if self.dynamics == "static":
            return state
        if self.dynamics == "iid":
            return self._within(self._draw(key, state.shape), params)
        step = _WALK * self.scale * jax.random.normal(key, state.shape)
        return self._within(jnp.clip(state + step, -self.scale, self.scale), params)

    def change_params(self, state: jax.Array, params: EnvParams) -> EnvParams:
        """Materials and ground in other colors."""
        if self.mode == "frame":
            return params
        geoms, look = params.geoms, params.look
        planes = [m for k, m in zip(geoms.kind, geoms.material, strict=True) if k == GeomKind.PLANE]
        if planes:
            ground = jnp.clip(look.ground_rgb + state[planes[0]], 0.0, 1.0)
            look = look.replace(ground_rgb=ground)
        return params.replace(geoms=geoms.replace(rgb=geoms.rgb + state), look=look)

    def change_frame(self, state: jax.Array, frame: Frame, backdrop: jax.Array | None) -> Frame:
        """The frame with the offset."""
        del backdrop
        if self.mode == "geom":
            return frame
        return frame.replace(
            r=jnp.clip(frame.r + state[0], 0.0, 1.0),
            g=jnp.clip(frame.g + state[1], 0.0, 1.0),
            b=jnp.clip(frame.b + state[2], 0.0, 1.0),
        )

    def info(self, state: jax.Array) -> dict[str, jax.Array]:
        """``color``: the shift."""
        return {"color": state}

    def _draw(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        if self.distribution == "normal":
            return self.scale * jax.random.normal(key, shape)
        return jax.random.uniform(key, shape, minval=-self.scale, maxval=self.scale)

    def _within(self, shift: jax.Array, params: EnvParams) -> jax.Array:
        """A shift of materials that leaves no color outside [0, 1]."""
        if self.mode == "frame":
            return shift
        rgb = jnp.asarray(params.geoms.rgb)
        return jnp.clip(rgb + shift, 0.0, 1.0) - rgb
