"""Random lights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax import spatial
from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.types import CameraRig, EnvParams
from pixelbrax_jax.validation import check_finite, check_fraction

_COEFFICIENTS = ("ambient", "diffuse", "specular", "highlight", "headlight", "headlight_highlight")
"""Coefficients of a look's light."""


class LightState(struct.PyTreeNode):
    """Light of an episode, relative to the undisturbed light.

    Attributes:
        azimuth: () float32, radians about the world's z axis, of the horizontal turn axis.
        angle: () float32, radians of the turn.
        intensity: () float32, factor.
        color: (3,) float32, factors of red, green and blue.
    """

    azimuth: jax.Array
    angle: jax.Array
    intensity: jax.Array
    color: jax.Array


@dataclass(frozen=True)
class Light(Distractor):
    """Changes direction, intensity and color of all lights, once per episode.

    Lights turn about a horizontal axis of random azimuth, by an angle that is uniform on [0,
    ``direction``]; see ``turn_lights``. Their intensity is multiplied by a factor that is uniform
    on [1 - ``intensity``, 1 + ``intensity``], and red, green and blue by one each on [1 -
    ``color``, 1 + ``color``]; see ``color_lights``.

    Attributes:
        direction: degrees in [0, 180].
        intensity: largest relative change in [0, 1].
        color: largest relative change of a channel in [0, 1].

    Raises:
        ValueError: an option is out of range.
    """

    direction: float = 40.0
    intensity: float = 0.4
    color: float = 0.4

    kind: ClassVar[str] = "light"
    stream: ClassVar[int] = 5
    only_colors: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0.0 <= check_finite("direction of Light", self.direction) <= 180.0:
            raise ValueError(
                f"direction of Light must lie in [0, 180] degrees, got {self.direction}."
            )
        check_fraction("intensity of Light", self.intensity)
        check_fraction("color of Light", self.color)

    def reset(self, key: jax.Array, params: EnvParams) -> LightState:
        """Sample the episode's light."""
        azimuth, angle, intensity, color = jax.random.split(key, 4)
        return LightState(
            azimuth=jax.random.uniform(azimuth, maxval=2.0 * jnp.pi),
            angle=jnp.radians(self.direction) * jax.random.uniform(angle),
            intensity=_factor(intensity, self.intensity),
            color=_factor(color, self.color, (3,)),
        )

    def change_params(self, state: LightState, params: EnvParams) -> EnvParams:
        """Return the parameters with other light."""
        params = turn_lights(params, state.azimuth, state.angle)
        return color_lights(scale_lights(params, state.intensity), state.color)

    def info(self, state: LightState) -> dict[str, jax.Array]:
        """Return ``light``, (6,): azimuth, angle, intensity, and factors of red, green and blue."""
        numbers = jnp.stack([state.azimuth, state.angle, state.intensity])
        return {"light": jnp.concatenate([numbers, state.color])}


def turn_lights(params: EnvParams, azimuth: jax.Array, angle: jax.Array) -> EnvParams:
    """Turn all lights by radians about the horizontal axis of this azimuth, () each.

    Spot lights turn about the origin of the link they follow, or else the first camera's target.
    """
    axis = jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth), 0.0])
    quat = spatial.axis_angle(axis, angle)
    look = params.look
    rig: CameraRig = params.rig[0] if isinstance(params.rig, tuple) else params.rig
    lamps = []
    for lamp in look.lamps:
        center = jnp.zeros(3) if lamp.link >= 0 else jnp.asarray(rig.target)
        pos = center + spatial.rotate(quat, jnp.asarray(lamp.pos) - center)
        axis_of_light = spatial.rotate(quat, jnp.asarray(lamp.axis))
        lamps.append(lamp.replace(pos=pos, axis=axis_of_light))
    light = None if look.light is None else spatial.rotate(quat, jnp.asarray(look.light))
    return params.replace(look=look.replace(light=light, lamps=tuple(lamps)))


def scale_lights(params: EnvParams, factor: jax.Array) -> EnvParams:
    """Multiply all coefficients of light by a factor, ()."""
    look = params.look
    names = [name for name in _COEFFICIENTS if getattr(look, name) is not None]
    scaled: dict[str, Any] = {name: getattr(look, name) * factor for name in names}
    lamps = tuple(
        lamp.replace(diffuse=lamp.diffuse * factor, highlight=lamp.highlight * factor)
        for lamp in look.lamps
    )
    return params.replace(look=look.replace(lamps=lamps, **scaled))


def color_lights(params: EnvParams, factors: jax.Array) -> EnvParams:
    """Multiply red, green and blue of all light by factors, (3,).

    The colors of materials and ground are multiplied, which is the same for all light that they
    scatter, and clipped to [0, 1]. Highlights and the sky stay as they are.
    """

    def lit(rgb: Any) -> jax.Array:
        return jnp.clip(jnp.asarray(rgb) * factors, 0.0, 1.0)

    geoms = params.geoms.replace(rgb=lit(params.geoms.rgb))
    look = params.look.replace(ground_rgb=lit(params.look.ground_rgb))
    return params.replace(geoms=geoms, look=look)


def _factor(key: jax.Array, amount: float, shape: tuple[int, ...] = ()) -> jax.Array:
    return jax.random.uniform(key, shape, minval=1.0 - amount, maxval=1.0 + amount)
