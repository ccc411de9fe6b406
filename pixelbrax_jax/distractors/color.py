"""Random colors of the image or of its materials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.types import EnvParams, Frame
from pixelbrax_jax.validation import check_bool, check_choice, check_fraction

MODES = ("frame", "geom")
DYNAMICS = ("iid", "walk", "static")
DISTRIBUTIONS = ("normal", "uniform")

_WALK = 0.03
"""Standard deviation of a walk's step in units of the scale, from the Distracting Control Suite."""


@dataclass(frozen=True)
class Color(Distractor):
    """Shifts colors by random amounts of size ``scale``.

    ``mode="frame"`` adds one offset (red, green, blue) to every pixel and clips to [0, 1].
    ``mode="geom"`` shifts every material's color and clips it to [0, 1]; the ground shifts like its
    material. With ``sky=True`` the sky shifts too: straight above by the whole amount, at the
    horizon by the whole amount (by half if the sky has a color below), and below not at all.

    A shift x is sampled from a normal distribution with standard deviation ``scale``, or from a
    uniform one on [-scale, scale], and is limited so that materials stay in [0, 1]. ``dynamics``
    decides when:

    * ``"static"``: once per episode,
    * ``"iid"``: for each frame,
    * ``"walk"``: once per episode, and then ``x += N(0, (0.03 scale)^2)`` for each frame, clipped
      to [-scale, scale].

    Sources: one normal offset per frame with standard deviation 0.3 is from the paper, arXiv
    2502.00021 (preset ``"paper-color"``). Materials on a walk are from the Distracting Control
    Suite, arXiv 2101.02722, at scales 0.1, 0.2, 0.3. New colors of robot, ground and sky in each
    episode are color-easy and color-hard of the DMControl Generalization Benchmark, arXiv
    2011.13389. It selects one of 100 recorded palettes, which are normal samples with standard
    deviation 0.1 and 0.2 about the true colors, clipped to [0, 1]; PixelBrax samples new ones.

    Attributes:
        mode: ``"frame"`` or ``"geom"``.
        dynamics: ``"iid"``, ``"walk"`` or ``"static"``.
        scale: size of the shift, in units of the color range [0, 1].
        distribution: ``"normal"`` or ``"uniform"``.
        sky: whether the sky shifts too; only with ``mode="geom"``.
        materials: the model's names of the materials that shift, only with ``mode="geom"``; None
            for all. If materials have no names, all shift.
        ground: whether the ground, planes with the look's checkers, shifts; ``"texture"`` darkens
            it by factors 1 + x, with x clipped to [-1, 0], as a change of the white material of a
            texture does. Other than True only with ``mode="geom"`` and without ``materials``.

    Raises:
        ValueError: an option is unknown or out of range; the message says what is allowed.
        TypeError: ``sky`` is no bool, or ``ground`` neither that nor ``"texture"``.
    """

    mode: str = "frame"
    dynamics: str = "iid"
    scale: float = 0.3
    distribution: str = "normal"
    sky: bool = False
    materials: tuple[str, ...] | None = None
    ground: bool | str = True

    kind: ClassVar[str] = "color"
    stream: ClassVar[int] = 1
    only_colors: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_choice("mode of Color", self.mode, MODES)
        check_choice("dynamics of Color", self.dynamics, DYNAMICS)
        check_choice("distribution of Color", self.distribution, DISTRIBUTIONS)
        check_fraction("scale of Color", self.scale)
        check_bool("sky of Color", self.sky)
        textured = isinstance(self.ground, str) and self.ground == "texture"
        if not (textured or isinstance(self.ground, (bool, np.bool_))):
            raise TypeError(
                f"ground of Color must be True, False or 'texture', got {self.ground!r}."
            )
        is_usual = bool(self.ground) and not textured
        if self.mode == "frame" and (self.sky or self.materials is not None or not is_usual):
            raise ValueError("sky, materials and ground of Color are only for mode='geom'.")
        if self.materials is not None and not is_usual:
            raise ValueError("materials of Color name all that shifts: leave out ground.")
        if self.materials is not None and not _are_names(self.materials):
            raise ValueError(
                f"materials of Color must be a tuple of names, such as ('self', 'grid'), or None, "
                f"got {self.materials!r}."
            )

    def reset(self, key: jax.Array, params: EnvParams) -> jax.Array:
        """Sample the shift: (3,) of the frame, or (M, 3) of the materials and then the sky."""
        shift = self._draw(key, params)
        # A walk starts inside its bounds.
        return self._in_box(shift, params) if self.dynamics == "walk" else shift

    def advance(
        self, state: jax.Array, key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> jax.Array:
        """Return the next shift."""
        if self.dynamics == "static":
            return state
        if self.dynamics == "iid":
            return self._draw(key, params)
        step = _WALK * self.scale * jax.random.normal(key, state.shape)
        return self._in_box(state + step, params)

    def change_params(self, state: jax.Array, params: EnvParams) -> EnvParams:
        """Return the parameters with shifted materials and ground."""
        if self.mode == "frame":
            return params
        geoms, look = params.geoms, params.look
        if self.sky:
            state, shift = state[:-1], state[-1]
            weights = (0.5, 1.0, 0.0) if look.sky.shape[0] == 3 else (1.0, 1.0)
            moved = jnp.asarray(look.sky) + jnp.array(weights)[:, None] * shift
            look = look.replace(sky=jnp.clip(moved, 0.0, 1.0))
        plane = _plane_material(params)
        if plane is not None:
            ground, shift = look.ground_rgb, state[plane]
            moved = ground * (1.0 + shift) if self.ground == "texture" else ground + shift
            look = look.replace(ground_rgb=moved)
        # A plane may share its material with other geoms that have tighter bounds.
        rgb = jnp.clip(geoms.rgb + state, 0.0, 1.0)
        return params.replace(geoms=geoms.replace(rgb=rgb), look=look)

    def change_frame(self, state: jax.Array, frame: Frame, backdrop: jax.Array | None) -> Frame:
        """Return the frame plus the offset."""
        if self.mode == "geom":
            return frame
        return frame.replace(
            r=jnp.clip(frame.r + state[0], 0.0, 1.0),
            g=jnp.clip(frame.g + state[1], 0.0, 1.0),
            b=jnp.clip(frame.b + state[2], 0.0, 1.0),
        )

    def info(self, state: jax.Array) -> dict[str, jax.Array]:
        """Return the shift as ``color``."""
        return {"color": state}

    def _draw(self, key: jax.Array, params: EnvParams) -> jax.Array:
        low, high = self._bounds(params)
        if self.distribution == "normal":
            return jnp.clip(self.scale * jax.random.normal(key, low.shape), low, high)
        low, high = jnp.maximum(low, -self.scale), jnp.minimum(high, self.scale)
        return jax.random.uniform(key, low.shape, minval=low, maxval=high)

    def _in_box(self, shift: jax.Array, params: EnvParams) -> jax.Array:
        low, high = self._bounds(params)
        return jnp.clip(shift, jnp.maximum(low, -self.scale), jnp.minimum(high, self.scale))

    def _bounds(self, params: EnvParams) -> tuple[jax.Array, jax.Array]:
        """Return bounds of the shift that keep every material in [0, 1]."""
        if self.mode == "frame":
            # The sum is clipped, not the shift.
            return jnp.full(3, -jnp.inf), jnp.full(3, jnp.inf)
        rgb = jnp.asarray(params.geoms.rgb)
        low, high = -rgb, 1.0 - rgb
        plane = _plane_material(params)
        if plane is not None:
            # Planes show the ground's colors instead of their own.
            ground = jnp.asarray(params.look.ground_rgb)
            down: Any = -ground.min(0)
            up: Any = 1 - ground.max(0)
            if isinstance(self.ground, str):
                down, up = -1.0, 0.0
            elif not self.ground:
                down, up = 0.0, 0.0
            low, high = low.at[plane].set(down), high.at[plane].set(up)
        names = params.geoms.material_name
        if self.materials is not None and names:
            if not set(self.materials) & set(names):
                raise ValueError(
                    f"the model has none of materials={self.materials!r} of Color; it has: "
                    f"{', '.join(sorted(filter(None, set(names)))) or 'none with a name'}."
                )
            moves = jnp.array([name in self.materials for name in names])[:, None]
            low, high = jnp.where(moves, low, 0.0), jnp.where(moves, high, 0.0)
        if self.sky:
            above = jnp.asarray(params.look.sky)[1]
            low = jnp.concatenate([low, -above[None]])
            high = jnp.concatenate([high, 1.0 - above[None]])
        return low, high


def _plane_material(params: EnvParams) -> int | None:
    for g, material in enumerate(params.geoms.material):
        if params.geoms.is_ground(g):
            return material
    return None


def _are_names(materials: object) -> bool:
    return isinstance(materials, tuple) and all(isinstance(m, str) and m for m in materials)
