"""Changes of one episode's parameters: direction of the camera, light, colors, sizes."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.camera import MovingCamera
from pixelbrax_jax.distractors.color import Color
from pixelbrax_jax.distractors.light import Light, color_lights, scale_lights, turn_lights
from pixelbrax_jax.types import CameraRig, EnvParams

NUM_VIEWS = 100
"""Number of directions of the camera in DMC-GB2; episode i and episode i + 100 have the same."""

_ROTATION_STRIDE, _SHIFT_STRIDE = 61, 47
"""Episode i takes direction (stride i) mod 100. Both strides visit all directions; the first few
are spread evenly, as are pairs of both."""


class Change:
    """A change of parameters, a frozen dataclass of plain numbers."""

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters of ONE episode with this index, () int32, and typed key."""
        raise NotImplementedError


@dataclass(frozen=True)
class Rotation(Change):
    """Turns the camera about its viewing axis by one of 100 angles, evenly in +- ``degrees``."""

    degrees: float

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters with a turned camera."""
        place = (_ROTATION_STRIDE * episode) % NUM_VIEWS
        angle = jnp.radians(self.degrees * (2.0 * place / NUM_VIEWS - 1.0))
        return _turn_cameras(params, jnp.array([0.0, 0.0, 1.0]), angle)


@dataclass(frozen=True)
class Shift(Change):
    """Turns the camera so that the body moves towards the border of the image.

    The angles about the camera's up axis (y) and right axis (x), degrees, are one of 100 points on
    the border of the rectangle of these ranges, 25 on each side from one corner on. The turn about
    y is applied after that about x.
    """

    y: tuple[float, float]
    x: tuple[float, float]

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters with a turned camera."""
        (left, right), (low, high) = self.y, self.x
        corners = np.array([(left, low), (right, low), (right, high), (left, high)], np.float32)
        place = (_SHIFT_STRIDE * episode) % NUM_VIEWS
        side, step = place // (NUM_VIEWS // 4), place % (NUM_VIEWS // 4)
        start, end = jnp.asarray(corners)[side], jnp.asarray(np.roll(corners, -1, 0))[side]
        about_y, about_x = jnp.radians(start + (end - start) * step / (NUM_VIEWS // 4))
        params = _turn_cameras(params, jnp.array([0.0, 1.0, 0.0]), about_y)
        return _turn_cameras(params, jnp.array([1.0, 0.0, 0.0]), about_x)


@dataclass(frozen=True)
class LightDirection(Change):
    """Turns all lights by an angle about a horizontal axis whose azimuth is sampled."""

    degrees: float

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters with turned lights."""
        azimuth = jax.random.uniform(key, maxval=2.0 * np.pi)
        return turn_lights(params, azimuth, jnp.radians(self.degrees))


@dataclass(frozen=True)
class LightIntensity(Change):
    """Multiplies all coefficients of light by 1 - ``amount`` or 1 + ``amount``, sampled."""

    amount: float

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters with darker or brighter light."""
        factor = jnp.where(jax.random.bernoulli(key), 1.0 + self.amount, 1.0 - self.amount)
        return scale_lights(params, factor)


@dataclass(frozen=True)
class LightColor(Change):
    """Multiplies red, green and blue of all light by factors on 1 +- ``amount``, sampled."""

    amount: float

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters in light of another color."""
        factor = jax.random.uniform(key, (3,), minval=1 - self.amount, maxval=1 + self.amount)
        return color_lights(params, factor)


@dataclass(frozen=True)
class BodyColor(Change):
    """Shifts the colors of all materials but the ground's by N(0, ``scale``^2), within [0, 1]."""

    scale: float

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters with other colors."""
        geoms = params.geoms
        of_ground = [m for g, m in enumerate(geoms.material) if geoms.is_ground(g)]
        rgb = jnp.asarray(geoms.rgb)
        moved = jnp.clip(rgb + self.scale * jax.random.normal(key, rgb.shape), 0.0, 1.0)
        kept = np.isin(np.arange(len(rgb)), of_ground)[:, None]
        return params.replace(geoms=geoms.replace(rgb=jnp.where(kept, rgb, moved)))


@dataclass(frozen=True)
class Radius(Change):
    """Multiplies radii in the image, not in physics, of geoms whose names start with ``names``."""

    factor: float
    names: tuple[str, ...]

    def change(self, params: EnvParams, key: jax.Array, episode: jax.Array) -> EnvParams:
        """Return the parameters with other sizes."""
        geoms = params.geoms
        rows = [g for g, name in enumerate(geoms.name) if name.startswith(self.names)]
        if not rows:
            raise ValueError(
                f"the task has no geom {' or '.join(self.names)}; it has {', '.join(geoms.name)}."
            )
        size = jnp.asarray(geoms.size).at[np.array(rows), 0].multiply(self.factor)
        return params.replace(geoms=geoms.replace(size=size))


def changes_params_alone(distractor: Distractor) -> bool:
    """Return whether a distractor only changes parameters, and only at an episode's start."""
    match distractor:
        case Color(mode="geom", dynamics="static") | MovingCamera(dynamic=False) | Light():
            return True
    return False


def _turn_cameras(params: EnvParams, axis: jax.Array, angle: jax.Array) -> EnvParams:
    """Turn cameras in place about a unit axis (3,) in their own frames, by radians."""
    quat = spatial.axis_angle(axis, angle)

    def turn(rig: CameraRig) -> CameraRig:
        away = jnp.asarray(rig.eye - rig.target)
        right, up, back = spatial.look_at(jnp.asarray(rig.eye), rig.target, rig.up).T

        def in_world(own: list[float]) -> jax.Array:
            x, y, z = spatial.rotate(quat, jnp.array(own))
            return x * right + y * up + z * back

        distance = jnp.sqrt(jnp.sum(away * away))
        target = rig.eye - distance * in_world([0.0, 0.0, 1.0])
        return rig.replace(target=target, up=in_world([0.0, 1.0, 0.0]))

    rig = jax.tree.map(turn, params.rig, is_leaf=lambda x: isinstance(x, CameraRig))
    return params.replace(rig=rig)
