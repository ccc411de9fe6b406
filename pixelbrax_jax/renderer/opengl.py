"""Light as OpenGL's fixed pipeline computes it for MuJoCo; vectors as in `intersect.py`.

Formulas are those of the OpenGL specification (2.1, section 2.14), with a local viewer. OpenGL
computes light at vertices. Those of a plane are far apart in MuJoCo (`render_context.c`), which
shows under a lamp, so they have their place here; those of other geoms are close enough for light
at each pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.renderer import shading
from pixelbrax_jax.renderer.intersect import Axes, Vector, at_least, at_most, between, dot
from pixelbrax_jax.renderer.view import vector
from pixelbrax_jax.types import Lamp, Look

_MOST_CELLS = 198
"""Cells of a plane along an axis, without those at its ends (``mjMAXPLANEGRID - 2``)."""

_BLUR = 1.3
"""Pixels in the edge of the square whose mean is nearest to what OpenGL's mipmaps show of a
checker, measured with MuJoCo's floors."""

_TINY = 1e-6

Light = Callable[[Vector, Vector, Vector], tuple[Any, Any]]
"""``light(ray, point, normal)`` returns what a light multiplies a surface's color by, and what it
adds, for the unit ray from the camera to the point."""


def lights_of(look: Look, back: Vector) -> list[Light]:
    """Return the ambient light with the headlight, then the directional light, then the lamps.

    ``look.light`` has unit length; ``back`` is the camera's back axis.
    """

    def ambient(ray: Vector, point: Vector, normal: Vector) -> tuple[Any, Any]:
        del point
        if look.headlight is None:
            return look.ambient, 0.0
        shade = look.ambient + look.headlight * at_least(dot(normal, back), 0.0)
        if look.headlight_highlight is None:
            return shade, 0.0
        return shade, look.headlight_highlight * _gloss(look, ray, normal, back)

    def sun(ray: Vector, point: Vector, normal: Vector) -> tuple[Any, Any]:
        del point
        to_light = (look.light[0], look.light[1], look.light[2])  # type: ignore[index]
        shine = _gloss(look, ray, normal, to_light)
        shade = look.diffuse * at_least(dot(normal, to_light), 0.0) + look.specular * shine
        return shade, look.highlight * shine

    def of_lamp(lamp: Lamp) -> Light:
        def light(ray: Vector, point: Vector, normal: Vector) -> tuple[Any, Any]:
            beam, _, strength = shading.beam(lamp, vector(lamp.pos), vector(lamp.axis), point)
            to_lamp = tuple(-component for component in beam)
            n_l = dot(normal, to_lamp)
            strength = jnp.where(n_l > 0.0, strength, 0.0)
            shine = _gloss(look, ray, normal, to_lamp)
            return strength * lamp.diffuse * n_l, strength * lamp.highlight * shine

        return light

    suns = [] if look.light is None else [sun]
    return [ambient, *suns, *map(of_lamp, look.lamps)]


def _gloss(look: Look, ray: Vector, normal: Vector, to_light: Vector) -> Any:
    """Return the highlight of the vector half way between light and camera."""
    n_l = dot(normal, to_light)
    inv_length = jax.lax.rsqrt(at_least(2.0 - 2.0 * dot(ray, to_light), _TINY))
    cosine = at_least((n_l - dot(normal, ray)) * inv_length, 0.0)
    return jnp.where(n_l > 0.0, cosine**look.shininess, 0.0)


def footprint(right: Vector, above: Vector) -> Any:
    """Return the width of the square of a texture that OpenGL shows in a pixel.

    The arguments are a texture's coordinates (2) of one pixel to the right and of one above. The
    level of a mipmap follows from the longer one alone.
    """
    squares = [x * x + y * y for x, y in (right, above)]
    return _BLUR * jnp.sqrt(at_least(at_least(squares[0], squares[1]), _TINY**2))


def on_texture(factors: tuple[Any, Any]) -> Any:
    """Return what a light multiplies a texture by: at most 1, highlight included."""
    return at_most(factors[0] + factors[1], 1.0)


def on_plane(
    lights: Sequence[Light], eye: Vector, center: Vector, axes: Axes, size: Vector, place: Vector
) -> list[Any]:
    """Return what lights multiply a plane's texture by, at a place along its x and y.

    Light is linear on the triangles of MuJoCo's grid, two in a cell, whose common edge goes from
    the corner of largest x and least y to the opposite one.
    """
    (low_x, high_x, x), (low_y, high_y, y) = (_cell(size, k, place[k]) for k in (0, 1))
    low = x + y <= 1.0
    third = jnp.where(low, low_x, high_x), jnp.where(low, low_y, high_y)
    corners = [
        (jnp.where(low, x, 1.0 - y), (high_x, low_y)),
        (jnp.where(low, y, 1.0 - x), (low_x, high_y)),
        (jnp.abs(1.0 - x - y), third),
    ]
    totals: list[Any] = [0.0] * len(lights)
    for weight, (along_x, along_y) in corners:
        point = tuple(center[k] + along_x * axes[0][k] + along_y * axes[1][k] for k in range(3))
        way = [p - e for p, e in zip(point, eye, strict=True)]
        square = dot(way, way)
        # A select, because XLA would store a root that has several readers.
        inv_distance = jnp.where(square > _TINY, jax.lax.rsqrt(at_least(square, _TINY)), 1.0)
        ray = tuple(component * inv_distance for component in way)
        for k, light in enumerate(lights):
            totals[k] += weight * on_texture(light(ray, point, axes[2]))
    return totals


def _cell(size: Vector, axis: int, place: Any) -> tuple[Any, Any, Any]:
    """Return the ends of a grid's cell along an axis, and the place between them, in [0, 1].

    The grid has an even number of cells of width ``2 size[2]``, then one at each end for the rest
    of the plane. An axis without end has a vertex everywhere.
    """
    half = size[axis]
    width = 2.0 * at_least(at_least(size[2], half / _MOST_CELLS), _TINY)
    # Without the summand a quotient that is whole might be rounded down.
    start = -width * jnp.floor(half / width + 1e-4)
    low = start + width * jnp.floor((place - start) * (1.0 / width))
    low, high = between(-half, low, half), between(-half, low + width, half)
    low, high = (jnp.where(half > 0.0, end, place) for end in (low, high))
    length = high - low
    # A select, because XLA would store a quotient that has several readers.
    inv_length = jnp.where(length > _TINY, 1.0 / at_least(length, _TINY), 0.0)
    return low, high, between(0.0, (place - low) * inv_length, 1.0)
