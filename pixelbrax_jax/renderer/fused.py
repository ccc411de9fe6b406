"""The fast renderer for any block of pixels; `docs/renderer.md` explains it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax import spatial
from pixelbrax_jax.renderer import shading
from pixelbrax_jax.renderer.intersect import (
    Axes,
    Hit,
    Vector,
    at_least,
    at_most,
    between,
    dot,
    intersect,
)
from pixelbrax_jax.renderer.shading import SHADOW_BIAS
from pixelbrax_jax.types import FAR, Frame, GeomKind, Lamp, Look, Scene

_INF_BITS = np.uint32(0x7F800000)


class View(struct.PyTreeNode):
    """A scene in the camera's frame.

    Static fields are ordered by rank; geoms of one material have neighboring ranks. Arrays are in
    the scene's order, with its shapes and units.

    Attributes:
        geom: (G,) static, the scene's index of each rank.
        kind, material, bounded, ground, distant: static, as in ``Geoms``.
        pos, xmat, size, rgb: centers, orientations, sizes and colors.
        look: light and lamps in the camera's frame.
        pixel: () float32, edge of a pixel at distance 1.
        up: (3,) float32, the world's z axis.
    """

    geom: tuple[int, ...] = struct.field(pytree_node=False)
    kind: tuple[int, ...] = struct.field(pytree_node=False)
    material: tuple[int, ...] = struct.field(pytree_node=False)
    bounded: tuple[bool, ...] = struct.field(pytree_node=False)
    ground: tuple[bool, ...] = struct.field(pytree_node=False)
    distant: bool = struct.field(pytree_node=False)
    pos: jax.Array
    xmat: jax.Array
    size: jax.Array
    rgb: jax.Array
    look: Look
    pixel: jax.Array
    up: jax.Array


class Seen(NamedTuple):
    """Colors, depth and geom of a block of pixels, each in the block's shape.

    Attributes:
        r, g, b: float32 in [0, 1].
        depth: float32, metres along the viewing axis, ``FAR`` for the sky; exact to a relative
            ``2**(b - 24)``, with b bits for a rank.
        rank: int32, rank of the geom; the number of geoms for the sky.
        ground: bool, whether a plane that is ground is visible.
    """

    r: jax.Array
    g: jax.Array
    b: jax.Array
    depth: jax.Array
    rank: jax.Array
    ground: jax.Array

    def frame(self, seg: jax.Array) -> Frame:
        """Return the frame, given the geom of each pixel; see ``Frame.seg``."""
        return Frame(r=self.r, g=self.g, b=self.b, depth=self.depth, seg=seg, ground=self.ground)


def view_of(
    scene: Scene, height: int, einsum: Callable[[str, Any, Any], jax.Array] = jnp.einsum
) -> View:
    """Return a scene in its camera's frame, for images of ``height`` pixels."""
    geoms, look = scene.geoms, scene.look
    to_camera = scene.camera.xmat
    light = None if look.light is None else einsum("i,ij->j", spatial.unit(look.light), to_camera)
    lamps = tuple(
        lamp.replace(
            pos=einsum("i,ij->j", lamp.pos - scene.camera.pos, to_camera),
            axis=einsum("i,ij->j", lamp.axis, to_camera),
        )
        for lamp in look.lamps
    )
    # Geoms of one material get neighboring ranks, so that a material is a range of ranks.
    order = sorted(range(len(geoms.kind)), key=lambda g: geoms.material[g])
    return View(
        geom=tuple(order),
        kind=tuple(geoms.kind[g] for g in order),
        material=tuple(geoms.material[g] for g in order),
        bounded=tuple(geoms.is_bounded(g) for g in order),
        ground=tuple(geoms.is_ground(g) for g in order),
        distant=geoms.distant,
        pos=einsum("gi,ij->gj", scene.pos - scene.camera.pos, to_camera),
        xmat=einsum("ji,gjk->gik", to_camera, scene.xmat),
        size=geoms.size,
        rgb=geoms.rgb,
        look=look.replace(light=light, lamps=lamps),
        pixel=2.0 * jnp.tan(jnp.deg2rad(scene.camera.fovy) / 2.0) / height,
        up=to_camera[2],
    )


def rays(view: View, height: int, width: int, row: jax.Array, column: jax.Array) -> Vector:
    """Return unit rays through the centers of pixels with the given int32 rows and columns."""
    x = (column.astype(jnp.float32) - 0.5 * (width - 1)) * view.pixel
    y = (0.5 * (height - 1) - row.astype(jnp.float32)) * view.pixel
    inv_length = jax.lax.rsqrt(x * x + y * y + 1.0)
    return x * inv_length, y * inv_length, -inv_length


Near = Callable[[int, Callable[[Any], Any], Any], Any]
"""``near(rank, update, value)`` returns ``update(value)`` if some pixel of a block may see the geom
of that rank, and may return ``value`` otherwise."""


def see(view: View, ray: Vector, near: Near | None = None) -> Seen:
    """Return what pixels with unit rays see; ``near`` may skip geoms that none sees."""
    look, shape = view.look, ray[0].shape
    ranks, count = range(len(view.kind)), len(view.kind)

    def solid(rank: int) -> _Solid:
        return _solid(view, rank)

    def hit(rank: int) -> Hit:
        return solid(rank).hit(ray, solid(rank).center)

    if near is None:
        # Branches cannot share results.
        solid, hit = cache(solid), cache(hit)

    to_light = None if look.light is None else _vector(look.light)
    along = _directions(ray, to_light, bool(look.lamps))
    key, products = _no_hit(count, shape), [jnp.zeros(shape)] * len(along)

    def update(rank: int, best: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
        entry = hit(rank)
        key = _nearer(best[0], entry, rank, count)
        return key, _normal_products(entry, along, key != best[0], best[1])

    for rank in ranks:
        if near is None:
            key = _nearer(key, hit(rank), rank, count)
        else:
            key, products = near(rank, partial(update, rank), (key, products))
    t, winner = _distance(key, count), _rank(key, count)
    seen = [winner == rank for rank in ranks]
    if near is None:
        # Only for the nearest geom: XLA on a CPU is faster without dependent selects.
        for rank in ranks:
            products = _normal_products(hit(rank), along, seen[rank], products)
    n_z, n_l, *n_xy = products
    sky = winner == count
    points = tuple(t * component for component in ray)

    color = _surface_colors(view, winner)
    for rank in ranks:
        if view.ground[rank]:
            fraction = _ground_fraction(look, ray, hit(rank).t, view.pixel, solid(rank))
            for c in range(3):
                first, second = look.ground_rgb[0, c], look.ground_rgb[1, c]
                color[c] = jnp.where(seen[rank], first + fraction * (second - first), color[c])

    shade: jax.Array = look.ambient
    highlight: jax.Array | float = 0.0
    on_ground = jnp.zeros(shape, bool)
    for rank in ranks:
        if view.ground[rank]:
            on_ground |= seen[rank]
    if look.headlight is not None:
        shade += look.headlight * at_least(n_z, 0.0)
        shade = jnp.where(on_ground, at_most(shade, 1.0), shade)
    if to_light is not None:
        lit = jnp.ones(shape, bool)
        if look.shadows:
            for rank in ranks:
                if view.kind[rank] != GeomKind.PLANE:
                    # A convex geom casts no shadow on its side that faces the light.
                    there = tuple(c - p for c, p in zip(solid(rank).center, points, strict=True))
                    blocked = solid(rank).hit(to_light, there).t > SHADOW_BIAS
                    lit &= ~(blocked & ~seen[rank])
        gloss = shading.gloss(n_l, n_z, to_light[2], look.shininess)
        gloss = jnp.where(lit & (n_l > 0.0), gloss, 0.0)
        diffuse = jnp.where(lit, at_least(n_l, 0.0), 0.0)
        shade = shade + look.diffuse * diffuse + look.specular * gloss
        highlight = look.highlight * gloss
    for lamp in look.lamps:
        more, shine = _lamplight(lamp, view, points, (*n_xy, n_z), seen, solid)
        shade, highlight = shade + more, highlight + shine
    if look.headlight is not None:
        # A texture dims the highlight too.
        shade = shade + jnp.where(on_ground, highlight, 0.0)
        highlight = jnp.where(on_ground, 0.0, highlight)

    rise = dot(ray, _vector(view.up))
    planes = []
    for c in range(3):
        surface = between(0.0, color[c] * shade + highlight, 1.0)
        planes.append(jnp.where(sky, shading.sky(look, rise, c), surface))
    depth = jnp.where(sky, FAR, -t * ray[2])
    return Seen(planes[0], planes[1], planes[2], depth, winner, on_ground)


def render(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> Frame:
    """Return a band of rows of an image of the scene; see ``base.render``."""
    # The barrier keeps these numbers out of the loop over pixels.
    view = jax.lax.optimization_barrier(view_of(scene, height))
    # All rows in one axis, because separate rows would end in pixels that do not fill a vector.
    index = jnp.arange(num_rows * width, dtype=jnp.int32)
    row = jax.lax.div(index, np.int32(width)) + first_row
    column = jax.lax.rem(index, np.int32(width))
    seen = see(view, rays(view, height, width, row, column))
    geom_of_rank = jnp.array([*view.geom, -1], jnp.int32)
    frame = seen.frame(geom_of_rank[seen.rank])
    return jax.tree.map(lambda plane: plane.reshape(num_rows, width), frame)


class _Solid(NamedTuple):
    kind: int
    center: Vector
    axes: Axes
    size: Vector
    bounded: bool
    distant: bool

    def hit(self, ray: Vector, center: Vector) -> Hit:
        """Return where rays enter it, with its center at another place."""
        return intersect(self.kind, ray, center, self.axes, self.size, self.bounded, self.distant)


def _solid(view: View, rank: int) -> _Solid:
    g = view.geom[rank]
    axes = [tuple(view.xmat[g, k, axis] for k in range(3)) for axis in range(3)]
    return _Solid(
        kind=view.kind[rank],
        center=tuple(view.pos[g, k] for k in range(3)),
        axes=(axes[0], axes[1], axes[2]),
        size=tuple(view.size[g, k] for k in range(3)),
        bounded=view.bounded[rank],
        distant=view.distant,
    )


def _vector(array: Any) -> Vector:
    return array[0], array[1], array[2]


def _directions(ray: Vector, to_light: Vector | None, lamps: bool) -> list[tuple[Vector, Any]]:
    """Return vectors whose products with normals are needed, each with its product with the ray."""
    zero = (0.0, 0.0, 0.0)
    along: list[tuple[Vector, Any]] = [((0.0, 0.0, 1.0), ray[2])]
    along.append((zero, 0.0) if to_light is None else (to_light, dot(ray, to_light)))
    if lamps:
        along += [((1.0, 0.0, 0.0), ray[0]), ((0.0, 1.0, 0.0), ray[1])]
    return along


def _normal_products(
    hit: Hit, along: list[tuple[Vector, Any]], here: jax.Array, products: list[jax.Array]
) -> list[jax.Array]:
    """Return products of the outer normal, those of ``hit`` where ``here`` is set."""
    return [
        jnp.where(here, hit.normal_dot(v, ray_v), product)
        for (v, ray_v), product in zip(along, products, strict=True)
    ]


def _lamplight(
    lamp: Lamp,
    view: View,
    points: Vector,
    normal: Vector,
    seen: list[jax.Array],
    solid: Callable[[int], _Solid],
) -> tuple[jax.Array, jax.Array]:
    """Return what a lamp adds to the factor of colors, and to the colors."""
    look, pos = view.look, _vector(lamp.pos)
    ray, inv_distance, strength = shading.beam(lamp, pos, _vector(lamp.axis), points)
    to_lamp = tuple(-component for component in ray)
    n_l = dot(normal, to_lamp)
    strength = jnp.where(n_l > 0.0, strength, 0.0)
    if look.shadows:
        for rank, kind in enumerate(view.kind):
            if kind != GeomKind.PLANE:
                there = tuple(c - p for c, p in zip(solid(rank).center, pos, strict=True))
                way = solid(rank).hit(ray, there).t
                blocked = (way > 0.0) & ((way + SHADOW_BIAS) * inv_distance < 1.0)
                strength = jnp.where(blocked & ~seen[rank], 0.0, strength)
    shine = shading.gloss(n_l, normal[2], to_lamp[2], look.shininess)
    return strength * lamp.diffuse * n_l, strength * lamp.highlight * shine


def _rank_bits(count: int) -> np.uint32:
    """Return the bits of a key that hold a rank; that of the sky is ``count``."""
    return np.uint32((1 << count.bit_length()) - 1)


def _no_hit(count: int, shape: tuple[int, ...]) -> jax.Array:
    return jnp.full(shape, (_INF_BITS & ~_rank_bits(count)) | np.uint32(count), jnp.uint32)


def _nearer(key: jax.Array, hit: Hit, rank: int, count: int) -> jax.Array:
    bits = jax.lax.bitcast_convert_type(hit.t, jnp.uint32)
    return jnp.minimum(key, (bits & ~_rank_bits(count)) | np.uint32(rank))


def _distance(key: jax.Array, count: int) -> jax.Array:
    return jax.lax.bitcast_convert_type(key & ~_rank_bits(count), jnp.float32)


def _rank(key: jax.Array, count: int) -> jax.Array:
    return (key & _rank_bits(count)).astype(jnp.int32)


def _surface_colors(view: View, winner: jax.Array) -> list[jax.Array]:
    materials = view.material
    color = [jnp.full(winner.shape, view.rgb[materials[0], c]) for c in range(3)]
    for rank in range(1, len(materials)):
        if materials[rank] != materials[rank - 1]:
            for c in range(3):
                color[c] = jnp.where(winner >= rank, view.rgb[materials[rank], c], color[c])
    return color


def _ground_fraction(
    look: Look, ray: Vector, t: jax.Array, pixel: jax.Array, plane: _Solid
) -> jax.Array:
    """Return the fraction of the ground's second color for pixels that see a plane at ``t``."""
    normal = plane.axes[2]
    slope = 1.0 / at_most(dot(ray, normal), -1e-7)
    inv_pitch = 1.0 / look.ground_pitch
    step = -t * ray[2] * pixel * inv_pitch
    coords, widths = [], []
    for number, (axis, half) in enumerate(zip(plane.axes[:2], plane.size[:2], strict=True)):
        ray_axis = dot(ray, axis)
        along = t * ray_axis - dot(plane.center, axis)
        if plane.bounded:
            # MuJoCo's textures start at the corner of least x and largest y.
            along = along + half if number == 0 else half - along
        coords.append(along * inv_pitch)
        # Derivatives of the coordinate by one pixel to the right and one up.
        right = axis[0] - ray_axis * slope * normal[0]
        above = axis[1] - ray_axis * slope * normal[1]
        widths.append(step * (jnp.abs(right) + jnp.abs(above)))
    return shading.second_color_fraction(look.ground, *coords, *widths)
