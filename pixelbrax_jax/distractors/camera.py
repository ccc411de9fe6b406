"""Random cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax import spatial
from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.types import CameraRig, EnvParams
from pixelbrax_jax.validation import check_bool, check_fraction

_RADIUS = 4.0
"""Distance from the target in metres for the suite's speeds; other distances scale them."""

_POLE = 0.02
"""Least angle in radians from straight above, where the up direction is undefined."""


class CameraState(struct.PyTreeNode):
    """Spherical coordinates of the camera about its target, relative to the undisturbed camera.

    Attributes:
        radius: () float32, ratio of the distances.
        azimuth, polar: () float32, radians about and from the world's z axis.
        roll, roll_velocity: () float32, radians about the viewing axis, and those per frame.
        velocity: (3,) float32, metres per frame.
    """

    radius: jax.Array
    azimuth: jax.Array
    polar: jax.Array
    roll: jax.Array
    velocity: jax.Array
    roll_velocity: jax.Array


@dataclass(frozen=True)
class MovingCamera(Distractor):
    """Moves the camera about its target.

    It stays in a box of spherical coordinates about the target. With b the ``scale`` and r0 the
    distance of the undisturbed camera: azimuth and polar angle within +- (pi/2) b of the
    undisturbed ones, the polar angle also within [0, pi/2] unless the camera looks up from below,
    so that it is not below the ground; roll within +- (pi/2) b; distance from (1 - b/2) r0 to (1 +
    3b/2) r0. An episode starts at a uniform sample from the box.

    With ``dynamic=True`` the velocity v is a random walk: ``v += N(0, (0.1 b s)^2)`` along each
    world axis, its length at most ``0.4 b s``, where ``s = r0 / 4``; the roll's velocity changes by
    ``N(0, (pi b / 300)^2)`` and is at most ``pi b / 50``. The camera moves by v and is clipped to
    the box, and v becomes the actual motion.

    Source: the Distracting Control Suite, arXiv 2101.02722 and its code, at scales 0.1, 0.2 and
    0.3. Two differences: distances are relative to the target of our camera rigs, not to the
    agent's center of mass (the target of a plain ``types.Camera`` is 1 m ahead; use a ``CameraRig``
    instead); and the suite's limit of the azimuth, which its cameras never reach, is omitted.

    Attributes:
        scale: b in [0, 1]; 0.1 is easy, 0.2 medium, 0.3 hard.
        dynamic: whether the camera moves within an episode.

    Raises:
        ValueError: the scale is out of range.
        TypeError: ``dynamic`` is no bool.
    """

    scale: float = 0.1
    dynamic: bool = True

    kind: ClassVar[str] = "camera"
    stream: ClassVar[int] = 3
    one_camera: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fraction("scale of MovingCamera", self.scale)
        check_bool("dynamic of MovingCamera", self.dynamic)

    def reset(self, key: jax.Array, params: EnvParams) -> CameraState:
        """Sample a position from the box, and a velocity."""
        low, high = self._box(params.rig)
        place_key, direction_key, speed_key, roll_key = jax.random.split(key, 4)
        place = jax.random.uniform(place_key, (4,), minval=low, maxval=high)
        direction = spatial.unit(jax.random.normal(direction_key, (3,)))
        fastest, roll_fastest = self._speeds(params.rig)
        still = not self.dynamic
        speed = jax.random.uniform(speed_key, maxval=fastest)
        roll_velocity = jax.random.uniform(roll_key, minval=-roll_fastest, maxval=roll_fastest)
        return CameraState(
            radius=place[0],
            azimuth=place[1],
            polar=place[2],
            roll=place[3],
            velocity=jnp.zeros(3) if still else speed * direction,
            roll_velocity=jnp.float32(0.0) if still else roll_velocity,
        )

    def advance(
        self, state: CameraState, key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> CameraState:
        """Take one step of the random walk."""
        if not self.dynamic:
            return state
        low, high = self._box(params.rig)
        fastest, roll_fastest = self._speeds(params.rig)
        noise = jax.random.normal(key, (4,))
        velocity = state.velocity + 0.25 * fastest * noise[:3]
        speed = jnp.linalg.norm(velocity)
        velocity *= jnp.minimum(1.0, fastest / jnp.maximum(speed, 1e-12))
        roll_velocity = state.roll_velocity + roll_fastest / 6.0 * noise[3]
        roll_velocity = jnp.clip(roll_velocity, -roll_fastest, roll_fastest)

        radius, azimuth, polar = _spherical(params.rig.eye - params.rig.target)
        before = _cartesian(state.radius * radius, state.azimuth + azimuth, state.polar + polar)
        new_radius, new_azimuth, new_polar = _spherical(before + velocity)
        # Relative to the undisturbed camera's azimuth, in [-pi, pi].
        turned = jnp.arctan2(jnp.sin(new_azimuth - azimuth), jnp.cos(new_azimuth - azimuth))
        place = jnp.stack([new_radius / radius, turned, new_polar - polar, 0.0])
        place = jnp.clip(place, low, high)
        after = _cartesian(place[0] * radius, place[1] + azimuth, place[2] + polar)
        roll = jnp.clip(state.roll + roll_velocity, low[3], high[3])
        return CameraState(
            radius=place[0],
            azimuth=place[1],
            polar=place[2],
            roll=roll,
            velocity=after - before,
            roll_velocity=roll - state.roll,
        )

    def change_params(self, state: CameraState, params: EnvParams) -> EnvParams:
        """Return the parameters with the moved camera."""
        rig = params.rig
        radius, azimuth, polar = _spherical(rig.eye - rig.target)
        away = _cartesian(state.radius * radius, state.azimuth + azimuth, state.polar + polar)
        # The horizon stays level, unless the camera looks straight down or up.
        turn = jnp.where(jnp.minimum(polar, jnp.pi - polar) < _POLE, 0.0, state.azimuth)
        level = _turn(jnp.asarray(rig.up), jnp.array([0.0, 0.0, 1.0]), turn)
        up = _turn(level, spatial.unit(away), state.roll)
        return params.replace(rig=rig.replace(eye=rig.target + away, up=up))

    def info(self, state: CameraState) -> dict[str, jax.Array]:
        """Return ``camera``, (4,): relative distance, azimuth, polar angle and roll."""
        return {"camera": jnp.stack([state.radius, state.azimuth, state.polar, state.roll])}

    def _box(self, rig: CameraRig) -> tuple[jax.Array, jax.Array]:
        """Return bounds of relative distance, azimuth, polar angle and roll."""
        _, _, polar = _spherical(rig.eye - rig.target)
        b, angle = self.scale, 0.5 * jnp.pi * self.scale
        # Not below the ground, unless the undisturbed camera is.
        lowest = jnp.maximum(0.5 * jnp.pi - polar, 0.0)
        highest = jnp.minimum(_POLE - polar, 0.0)
        low = jnp.stack([1.0 - 0.5 * b, -angle, jnp.maximum(-angle, highest), -angle])
        high = jnp.stack([1.0 + 1.5 * b, angle, jnp.minimum(angle, lowest), angle])
        return low, high

    def _speeds(self, rig: CameraRig) -> tuple[jax.Array, float]:
        """Return the largest velocities: metres per frame, and radians of roll per frame."""
        radius = jnp.linalg.norm(rig.eye - rig.target)
        return 0.4 * self.scale * radius / _RADIUS, float(jnp.pi) * self.scale / 50.0


def _spherical(away: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    x, y, z = jnp.asarray(away)
    # Straight above neither the azimuth nor the square root has a derivative.
    pole = (x == 0.0) & (y == 0.0)
    across = jnp.where(pole, 0.0, jnp.sqrt(jnp.where(pole, 1.0, x * x + y * y)))
    azimuth = jnp.arctan2(jnp.where(pole, 0.0, y), jnp.where(pole, 1.0, x))
    return jnp.sqrt(x * x + y * y + z * z), azimuth, jnp.arctan2(across, z)


def _cartesian(radius: jax.Array, azimuth: jax.Array, polar: jax.Array) -> jax.Array:
    across = jnp.sin(polar)
    return radius * jnp.stack(
        [across * jnp.cos(azimuth), across * jnp.sin(azimuth), jnp.cos(polar)]
    )


def _turn(vector: jax.Array, axis: jax.Array, angle: jax.Array) -> jax.Array:
    """Rotate a vector about a unit axis, by Rodrigues' formula."""
    along = jnp.dot(axis, vector) * axis
    return along + jnp.cos(angle) * (vector - along) + jnp.sin(angle) * jnp.cross(axis, vector)
