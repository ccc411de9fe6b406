"""Intersections of a ray from the origin with one convex geom.

A vector is a tuple of three components, each a scalar or an array over pixels: the same code serves
camera rays (ray in arrays, geom in scalars) and shadow rays (ray in scalars, geom in arrays). Rays
have unit length and enter a geom from outside. A missed geom gives NaN or a negative distance,
never +inf, as `fused.py` requires. Each quotient and root is used once, because XLA stores an image
of it if two operations read it.
"""

# ruff: noqa: ARG001, ARG005  # all shapes share one signature, whatever they need of it
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.types import GeomKind

Vector = Sequence[Any]
Axes = tuple[Vector, Vector, Vector]
Fold = Callable[[Callable[[Vector], Vector], Callable[[Any, Vector], Any], Any], Any]
"""``fold(prepare, update, value)`` applies ``value = update(value, prepare(plane))`` for each
half-space of a mesh, and returns the last value. A plane is its outer unit normal and its distance
from the center, in the geom's frame."""

_TINY = 1e-7
"""Avoids a division by zero for a ray parallel to an axis or a face."""

_FAR = 1e30
"""Larger than any distance, and than one over it."""


class Hit(NamedTuple):
    """The point where a ray enters a geom: ``t`` metres from the origin, NaN or negative for none.

    ``normal_dot(v, ray_v)`` is the outer unit normal times ``v``, given the ray times ``v``.
    """

    t: jax.Array
    normal_dot: Callable[[Vector, jax.Array], jax.Array]


def at_least(x: Any, low: Any) -> jax.Array:
    """Return the larger of the two; ``low`` if ``x`` is NaN, and NaN if ``low`` is.

    It is one CPU instruction. ``jnp.maximum`` needs two more to propagate NaN from both sides.
    """
    return jnp.where(x > low, x, low)


def at_most(x: Any, high: Any) -> jax.Array:
    """Return the smaller of the two; ``high`` if ``x`` is NaN, and NaN if ``high`` is."""
    return jnp.where(x < high, x, high)


def between(low: Any, x: Any, high: Any) -> jax.Array:
    """Clip ``x`` to an interval; ``low`` for NaN."""
    return at_most(at_least(x, low), high)


def dot(a: Vector, b: Vector) -> jax.Array:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _inverse(x: jax.Array) -> jax.Array:
    """Return ``1 / x``, or a large number if ``x`` is nearly 0."""
    return jnp.where(jnp.abs(x) < _TINY, 1.0 / _TINY, 1.0 / x)


def _plane(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    normal = axes[2]
    descent = dot(ray, normal)
    # Visible only from above; from below the quotient is negative.
    t = jnp.where(descent < -_TINY, dot(pos, normal) / at_most(descent, -_TINY), -1.0)
    return Hit(t, lambda v, ray_v: dot(normal, v))


def _rectangle(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    t, normal_dot = _plane(ray, pos, axes, size)
    inside: bool | jax.Array = True
    for axis, half in zip(axes[:2], size[:2], strict=True):
        reach = jnp.where(half > 0.0, half, jnp.inf)
        inside &= jnp.abs(t * dot(ray, axis) - dot(pos, axis)) <= reach
    return Hit(jnp.where(inside, t, -1.0), normal_dot)


def _distant_sphere(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    b = dot(ray, pos)
    apart = [p - b * r for p, r in zip(pos, ray, strict=True)]
    t = b - jnp.sqrt(size[0] * size[0] - dot(apart, apart))
    inv_radius = 1.0 / size[0]
    return Hit(t, lambda v, ray_v: (t * ray_v - dot(pos, v)) * inv_radius)


def _distant_capsule(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    # As below, but distances between lines are products of small numbers. Differences of large
    # numbers are exact only to a three thousandth of the distance.
    radius, half, axis = size[0], size[1], axes[2]
    pos_axis = dot(pos, axis)
    ray_axis, ray_pos = dot(ray, axis), dot(ray, pos)
    a = at_least(1.0 - ray_axis * ray_axis, _TINY)
    b = ray_pos - ray_axis * pos_axis
    apart = dot(ray, _cross(axis, pos))
    y = (b - jnp.sqrt(a * (radius * radius) - apart * apart)) / a * ray_axis - pos_axis
    y = between(-half, y, half)
    center = [p + y * along for p, along in zip(pos, axis, strict=True)]
    return _distant_sphere(ray, center, axes, size)


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _sphere(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    b = dot(ray, pos)
    t = b - jnp.sqrt(b * b - (dot(pos, pos) - size[0] * size[0]))
    inv_radius = 1.0 / size[0]
    return Hit(t, lambda v, ray_v: (t * ray_v - dot(pos, v)) * inv_radius)


def _capsule(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    radius, half, axis = size[0], size[1], axes[2]
    pos_axis, pos_pos = dot(pos, axis), dot(pos, pos)
    ray_axis, ray_pos = dot(ray, axis), dot(ray, pos)
    # The line enters the infinite cylinder at axial coordinate y. Clamped to the segment, y is
    # the center of the only sphere on it through which the line can enter the capsule.
    a = at_least(1.0 - ray_axis * ray_axis, _TINY)
    b = ray_pos - ray_axis * pos_axis
    c = pos_pos - pos_axis * pos_axis - radius * radius
    y = (b - jnp.sqrt(b * b - a * c)) / a * ray_axis - pos_axis
    # For a line that misses the cylinder, NaN is clamped to an end, whose sphere it misses too.
    y = between(-half, y, half)
    b = ray_pos + y * ray_axis
    c = (pos_pos - radius * radius) + y * (2.0 * pos_axis + y)
    t = b - jnp.sqrt(b * b - c)
    inv_radius = 1.0 / radius
    return Hit(t, lambda v, ray_v: (t * ray_v - dot(pos, v) - y * dot(axis, v)) * inv_radius)


def _ellipsoid(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    # In coordinates divided by the radii the ellipsoid is the unit sphere.
    inv_size = [1.0 / radius for radius in size]
    d = [dot(ray, axis) * inv for axis, inv in zip(axes, inv_size, strict=True)]
    o = [-dot(pos, axis) * inv for axis, inv in zip(axes, inv_size, strict=True)]
    a, b, c = dot(d, d), dot(d, o), dot(o, o) - 1.0
    t = (-b - jnp.sqrt(b * b - a * c)) * (1.0 / a)
    n = [(o[k] + t * d[k]) * inv_size[k] for k in range(3)]
    square = dot(n, n)

    def normal_dot(v: Vector, ray_v: jax.Array) -> jax.Array:
        return dot(n, [dot(axis, v) for axis in axes]) * jax.lax.rsqrt(square)

    return Hit(t, normal_dot)


def _cylinder(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    radius, half, axis = size[0], size[1], axes[2]
    pos_axis, pos_pos = dot(pos, axis), dot(pos, pos)
    ray_axis, ray_pos = dot(ray, axis), dot(ray, pos)
    a = at_least(1.0 - ray_axis * ray_axis, _TINY)
    b = ray_pos - ray_axis * pos_axis
    c = pos_pos - pos_axis * pos_axis - radius * radius
    t_side = (b - jnp.sqrt(b * b - a * c)) * (1.0 / a)
    y = t_side * ray_axis - pos_axis
    on_side = jnp.abs(y) <= half  # False for NaN
    # Otherwise the ray can only enter through the cap that faces it.
    inv_slant = _inverse(ray_axis)
    facing = jnp.where(inv_slant > 0, -1.0, 1.0)
    t_cap = (facing * half + pos_axis) * inv_slant
    from_axis = (t_cap - 2.0 * ray_pos) * t_cap + (pos_pos - half * half)
    t = jnp.where(on_side, t_side, jnp.where(from_axis <= radius * radius, t_cap, -1.0))
    inv_radius = 1.0 / radius

    def normal_dot(v: Vector, ray_v: jax.Array) -> jax.Array:
        axis_v = dot(axis, v)
        side = (t * ray_v - dot(pos, v) - y * axis_v) * inv_radius
        return jnp.where(on_side, side, facing * axis_v)

    return Hit(t, normal_dot)


def _box(ray: Vector, pos: Vector, axes: Axes, size: Vector) -> Hit:
    inv_d = [_inverse(dot(ray, axis)) for axis in axes]
    o = [-dot(pos, axis) for axis in axes]
    facing = [jnp.where(inv_d[k] > 0, -1.0, 1.0) for k in range(3)]
    near = [(facing[k] * size[k] - o[k]) * inv_d[k] for k in range(3)]
    far = [(-facing[k] * size[k] - o[k]) * inv_d[k] for k in range(3)]
    entry = at_least(at_least(near[0], near[1]), near[2])
    leave = at_most(at_most(far[0], far[1]), far[2])
    t = jnp.where(entry <= leave, entry, -1.0)

    def normal_dot(v: Vector, ray_v: jax.Array) -> jax.Array:
        by_face = [facing[k] * dot(axes[k], v) for k in range(3)]
        yz = jnp.where(near[1] >= near[2], by_face[1], by_face[2])
        return jnp.where((near[0] >= near[1]) & (near[0] >= near[2]), by_face[0], yz)

    return Hit(t, normal_dot)


def _mesh(ray: Vector, pos: Vector, axes: Axes, size: Fold) -> Hit:
    # Whichever of ray and geom is in scalars divides, so that a pixel needs no quotient per plane.
    # If it is the ray, `order` is minus the distance at which the ray crosses a plane, else one
    # over it. Both are linear in the pixel's numbers. Either way the ray enters through the plane
    # of least order among those it crosses inwards, if that is not below those crossed outwards.
    by_ray = jnp.ndim(ray[0]) > 0
    d = [dot(ray, axis) for axis in axes]
    o = [-dot(pos, axis) for axis in axes]
    shape = jnp.broadcast_shapes(jnp.shape(ray[0]), jnp.shape(pos[0]))

    def prepare(plane: Vector) -> Vector:
        *own, offset = plane
        # Outside of the planes that the ray crosses inwards, inside of the others.
        side = offset - dot(own, o) if by_ray else dot(own, d)
        inv = 1.0 / jnp.where(jnp.abs(side) < _TINY, _TINY, side)
        return (*own, *(n * inv for n in own), offset * inv, inv < 0.0)

    def cut(best: tuple[Any, ...], plane: Vector) -> tuple[Any, ...]:
        enter, leave, *normal = best
        *own, x, y, z, shift, inwards = plane
        order = dot((x, y, z), d) if by_ray else dot((x, y, z), o) - shift
        first = inwards & (order < enter)
        enter = jnp.where(first, order, enter)
        leave = jnp.where(inwards, leave, at_least(order, leave))
        return enter, leave, *(jnp.where(first, n, m) for n, m in zip(own, normal, strict=True))

    never = jnp.full(shape, _FAR)
    start = (never, jnp.full(shape, _TINY) if by_ray else -never, *[jnp.zeros(shape)] * 3)
    enter, leave, *normal = size(prepare, cut, start)
    hit = (enter >= leave) & (enter < _FAR)
    t = jnp.where(hit, 1.0 / enter if by_ray else -enter, -1.0)
    return Hit(t, lambda v, ray_v: dot(normal, [dot(axis, v) for axis in axes]))


_BY_KIND: dict[GeomKind, Callable[[Vector, Vector, Axes, Any], Hit]] = {
    GeomKind.PLANE: _plane,
    GeomKind.SPHERE: _sphere,
    GeomKind.CAPSULE: _capsule,
    GeomKind.ELLIPSOID: _ellipsoid,
    GeomKind.CYLINDER: _cylinder,
    GeomKind.BOX: _box,
    GeomKind.MESH: _mesh,
}

_FAR_FORMS = {GeomKind.SPHERE: _distant_sphere, GeomKind.CAPSULE: _distant_capsule}
"""For distant cameras."""

assert set(_BY_KIND) == set(GeomKind), f"no formulas: {set(GeomKind) - set(_BY_KIND)}"
assert set(_FAR_FORMS) == {kind for kind in GeomKind if kind.has_far_form}


def intersect(
    kind: int,
    ray: Vector,
    pos: Vector,
    axes: Axes,
    size: Any,
    bounded: bool = False,
    distant: bool = False,
) -> Hit:
    """Return where unit rays from the origin enter a geom.

    ``pos`` is its center in metres; ``size`` is a vector as in ``Geoms``, for a mesh a ``Fold``.
    """
    if bounded and kind == GeomKind.PLANE:
        return _rectangle(ray, pos, axes, size)
    kind = GeomKind(kind)
    formulas = _FAR_FORMS if distant and kind.has_far_form else _BY_KIND
    return formulas[kind](ray, pos, axes, size)
