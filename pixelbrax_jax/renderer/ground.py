"""The pattern on the ground, averaged over each pixel so that it never flickers.

A plane carries a pattern that is a product of two one-dimensional ones, along its own x and y.
A pixel sees a parallelogram of the plane; the pattern is averaged exactly over the smallest
axis-aligned rectangle around it, from the pattern's integral. Towards the horizon the
average tends to a constant, where point samples would alias.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from pixelbrax_jax.renderer.bounds import at_least, at_most

LINE_WIDTH = 1.0 / 84.0
"""Width of a grid line in grid pitches: one texel of the original's texture at 84 pixels."""


def _average(
    integral: Callable[[jax.Array], jax.Array], center: jax.Array, width: jax.Array
) -> jax.Array:
    """Return the mean of a periodic function of period 1 over a window, given its integral."""
    width = at_least(width, 1e-4)
    return (integral(center + 0.5 * width) - integral(center - 0.5 * width)) / width


def _square_wave_integral(x: jax.Array) -> jax.Array:
    """Return the integral of the wave that is +1 on [0, 1/2) and -1 on [1/2, 1)."""
    return 0.5 - jnp.abs(x - jnp.floor(x) - 0.5)


def _line_integral(x: jax.Array) -> jax.Array:
    """Return the integral of what is 1 on [0, LINE_WIDTH) and 0 on the rest of [0, 1)."""
    whole = jnp.floor(x)
    return LINE_WIDTH * whole + at_most(x - whole, LINE_WIDTH)


def second_color_fraction(
    pattern: str, x: jax.Array, y: jax.Array, width_x: jax.Array, width_y: jax.Array
) -> jax.Array:
    """Return how much of the ground's second color a pixel sees.

    Args:
        pattern: ``"checker"`` or ``"grid"``.
        x: ground coordinate at the pixel's center, in pitches, any shape.
        y: the other coordinate.
        width_x: extent of the pixel's footprint along x, in pitches, positive.
        width_y: the other extent.

    Returns:
        Values in [0, 1] of the same shape.
    """
    if pattern == "checker":
        # A checker is the product of two waves whose period is two tiles.
        wave_x = _average(_square_wave_integral, 0.5 * x, 0.5 * width_x)
        wave_y = _average(_square_wave_integral, 0.5 * y, 0.5 * width_y)
        return 0.5 - 0.5 * wave_x * wave_y
    line_x = _average(_line_integral, x, width_x)
    line_y = _average(_line_integral, y, width_y)
    return 1.0 - (1.0 - line_x) * (1.0 - line_y)
