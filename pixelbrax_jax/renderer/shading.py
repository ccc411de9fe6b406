"""Light, sky and the ground's pattern for pixels of any shape; vectors as in `intersect.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax._platform.by_platform import computed_once, traced
from pixelbrax_jax.renderer.intersect import Vector, at_least, at_most, between, dot
from pixelbrax_jax.types import Lamp, Look

LINE_WIDTH = 1.0 / 84.0
"""Width of a grid line in grid pitches: one texel of the original's texture at 84 pixels."""

SHADOW_BIAS = 1e-3
"""Least distance in metres of a shadow ray's hit."""


def gloss(n_l: jax.Array, n_z: jax.Array, light_z: Any, shininess: int) -> jax.Array:
    """Return Phong's ``max(r_z, 0) ** shininess`` for a viewer at infinity, see ``Look``.

    The arguments are the products of normal and light, and of either and the camera's back axis.
    """
    return at_least(2.0 * n_l * n_z - light_z, 0.0) ** shininess


def beam(lamp: Lamp, pos: Vector, axis: Vector, points: Vector) -> tuple[Vector, Any, Any]:
    """Return unit directions from a lamp to points, 1 / distance (metres), strength in [0, 1]."""
    away = [p - c for p, c in zip(points, pos, strict=True)]
    square = dot(away, away)
    # A select, because XLA would store a root that has several readers.
    # The inner one keeps derivatives finite.
    safe = jnp.where(square > 0.0, square, 1.0)
    inv_distance = jnp.where(square > 0.0, jax.lax.rsqrt(safe), 1.0)
    ray = tuple(component * inv_distance for component in away)
    along = dot(ray, axis)
    strength = jnp.where(along >= lamp.cos_cutoff, at_least(along, 0.0) ** lamp.exponent, 0.0)
    return ray, inv_distance, strength


def computed_apart(compute: Callable[[], list[jax.Array]]) -> list[jax.Array]:
    """Return values in [0, 1], rounded to 10 bits, that XLA computes in a separate loop.

    Too long a loop over pixels compiles slowly, and XLA then recomputes values in it, as it does
    for each of several results. So three values share a word. There is no derivative.
    """
    program, compute_values, values = traced(compute)
    like = [jax.ShapeDtypeStruct(value.shape, jnp.uint32) for value in values[::3]]

    def words(consts: list[jax.Array]) -> list[jax.Array]:
        return to_words(compute_values(consts))

    return from_words(computed_once(words, (program.consts,), like), len(values))


def to_words(values: Sequence[jax.Array]) -> list[jax.Array]:
    """Round values in [0, 1] to 10 bits, three in each uint32."""
    levels = [(value * 1023.0 + 0.5).astype(jnp.uint32) for value in values]
    words = []
    for first in range(0, len(levels), 3):
        word = levels[first]
        for k, level in enumerate(levels[first + 1 : first + 3], 1):
            word |= level << 10 * k
        words.append(word)
    return words


def from_words(words: Sequence[jax.Array], count: int) -> list[jax.Array]:
    """Return the ``count`` values of ``to_words``, float32."""
    return [
        ((words[k // 3] >> 10 * (k % 3)) & 1023).astype(jnp.float32) / 1023.0 for k in range(count)
    ]


def sky(look: Look, rise: jax.Array, channel: int) -> jax.Array:
    """Return one channel of the sky's color for the z component of unit rays in the world frame."""
    horizon, above, *below = (look.sky[row, channel] for row in range(look.sky.shape[0]))
    color = horizon + between(0.0, rise, 1.0) * (above - horizon)
    if below:
        color += between(0.0, -rise, 1.0) * (below[0] - horizon)
    return color


def sky_texture(texture: jax.Array, x: jax.Array, y: jax.Array, z: jax.Array) -> jax.Array:
    """Return what the sky's texture adds for rays (N,) of any length in the world frame, (N, 3).

    Between texels it is linear, as in OpenGL, but not across the edges of the cube. Faces and their
    coordinates are those of the OpenGL specification (4.6, table 8.19).
    """
    s, t, r = x, z, -y  # the cube's y is up
    on_s = (jnp.abs(s) >= jnp.abs(t)) & (jnp.abs(s) >= jnp.abs(r))
    on_t = ~on_s & (jnp.abs(t) >= jnp.abs(r))
    major = jnp.where(on_s, s, jnp.where(on_t, t, r))
    sign = jnp.where(major < 0.0, -1.0, 1.0)
    face = jnp.where(on_s, 0, jnp.where(on_t, 2, 4)) + (major < 0.0)
    across = jnp.where(on_s, -sign * r, jnp.where(on_t, s, sign * s))
    down = jnp.where(on_t, sign * r, -t)
    size = texture.shape[1]
    inv = 0.5 * size / jnp.abs(major)
    column, row = (
        between(0.0, along * inv + 0.5 * (size - 1), size - 1.0) for along in (across, down)
    )
    left, top = jnp.floor(column), jnp.floor(row)
    right_share, bottom_share = (column - left)[:, None], (row - top)[:, None]
    texels = texture.reshape(-1, 3)

    def row_of_two(row: jax.Array) -> jax.Array:
        start = (face * size + row.astype(jnp.int32)) * size
        first = texels[start + left.astype(jnp.int32)]
        second = texels[start + at_most(left + 1.0, size - 1.0).astype(jnp.int32)]
        return first + right_share * (second - first)

    above, below = row_of_two(top), row_of_two(at_most(top + 1.0, size - 1.0))
    return above + bottom_share * (below - above)


def _average(
    integral: Callable[[jax.Array], jax.Array], center: jax.Array, width: jax.Array
) -> jax.Array:
    """Return the mean of a function of period 1 over a window, given its integral."""
    width = at_least(width, 1e-4)
    return (integral(center + 0.5 * width) - integral(center - 0.5 * width)) / width


def _square_wave_integral(x: jax.Array) -> jax.Array:
    """Return the integral of the wave that is +1 on [0, 1/2) and -1 on [1/2, 1)."""
    return 0.5 - jnp.abs(x - jnp.floor(x) - 0.5)


def _line_integral(x: jax.Array) -> jax.Array:
    """Return the integral of 1 on [0, LINE_WIDTH) and 0 on the rest of [0, 1)."""
    whole = jnp.floor(x)
    return LINE_WIDTH * whole + at_most(x - whole, LINE_WIDTH)


def _marked_wave_integral(x: jax.Array, mark: jax.Array) -> jax.Array:
    """Return the integral of the same wave with zeros at less than ``mark`` from whole numbers."""
    return at_least(_square_wave_integral(x) - mark, 0.0)


def _between_marks_integral(x: jax.Array, mark: jax.Array) -> jax.Array:
    """Return the integral of 0 at less than ``mark`` from whole numbers, and 1 elsewhere."""
    whole = jnp.floor(x)
    return whole * (1.0 - 2.0 * mark) + between(0.0, x - whole - mark, 1.0 - 2.0 * mark)


def second_color_fraction(
    look: Look, x: jax.Array, y: jax.Array, width_x: jax.Array, width_y: jax.Array
) -> jax.Array:
    """Return the fraction of the ground's second color in a pixel, in [0, 1].

    The pattern is ``"checker"`` or ``"grid"``, a product of two one-dimensional patterns. In units
    of its pitch, (x, y) is the ground at the pixel's center, and the widths are the positive
    extents of the ground that the pixel sees. The mean over the area is exact, so nothing flickers.
    """
    pattern = look.ground
    if pattern == "checker" and look.ground_mark is not None:
        # Between the marks tiles are the first color where both waves have one sign.
        first: Any = 0.0
        for function in (_between_marks_integral, _marked_wave_integral):
            integral = partial(function, mark=0.5 * look.ground_mark)
            of_x = _average(integral, 0.5 * x, 0.5 * width_x)
            first += 0.5 * of_x * _average(integral, 0.5 * y, 0.5 * width_y)
        return 1.0 - first
    if pattern == "checker":
        # A checker is the product of two waves with a period of two tiles.
        wave_x = _average(_square_wave_integral, 0.5 * x, 0.5 * width_x)
        wave_y = _average(_square_wave_integral, 0.5 * y, 0.5 * width_y)
        return 0.5 - 0.5 * wave_x * wave_y
    line_x = _average(_line_integral, x, width_x)
    line_y = _average(_line_integral, y, width_y)
    return 1.0 - (1.0 - line_x) * (1.0 - line_y)
