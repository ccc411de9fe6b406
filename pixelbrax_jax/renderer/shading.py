"""Light, sky and the ground's color, for pixels of any shape.

As in `intersect.py` a vector is a tuple of three components, each a scalar or an array over pixels,
and all vectors of a call are in one frame: the camera's, or the world's.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.renderer.bounds import at_least, between
from pixelbrax_jax.renderer.intersect import Vector, dot
from pixelbrax_jax.types import Lamp, Look

SHADOW_BIAS = 1e-3
"""Metres that a shadow ray must travel before a hit counts."""


def gloss(n_l: jax.Array, n_z: jax.Array, light_z: Any, shininess: int) -> jax.Array:
    """Return Phong's ``max(r_z, 0) ** shininess`` for a viewer at infinity, see ``Look``.

    Args:
        n_l: product of normal and direction to the light.
        n_z: product of normal and the camera's back axis.
        light_z: product of the direction to the light and that axis.
        shininess: the exponent.
    """
    return at_least(2.0 * n_l * n_z - light_z, 0.0) ** shininess


def beam(lamp: Lamp, pos: Vector, axis: Vector, points: Vector) -> tuple[Vector, Any, Any]:
    """Return how a lamp shines at points.

    Args:
        lamp: exponent and cutoff.
        pos: metres, where it is.
        axis: unit direction in which it shines.
        points: metres.

    Returns:
        Unit directions from the lamp to the points; one over their distances in metres; how
        strong the lamp is there, in [0, 1].
    """
    away = [p - c for p, c in zip(points, pos, strict=True)]
    square = dot(away, away)
    # A choice, for XLA would keep the root itself in memory: it has several readers.
    inv_distance = jnp.where(square > 0.0, jax.lax.rsqrt(square), 1.0)
    ray = tuple(component * inv_distance for component in away)
    along = dot(ray, axis)
    strength = jnp.where(along >= lamp.cos_cutoff, at_least(along, 0.0) ** lamp.exponent, 0.0)
    return ray, inv_distance, strength


def sky(look: Look, rise: jax.Array, channel: int) -> jax.Array:
    """Return one channel of the sky's color.

    Args:
        look: whose sky it is.
        rise: z of unit rays in the world frame.
        channel: 0 red, 1 green, 2 blue.
    """
    horizon, above, *below = (look.sky[row, channel] for row in range(look.sky.shape[0]))
    color = horizon + between(0.0, rise, 1.0) * (above - horizon)
    if below:
        color += between(0.0, -rise, 1.0) * (below[0] - horizon)
    return color
