"""The fast ray-caster: one fused loop over pixels, every geom unrolled.

It works in the camera's frame, where all rays start at the origin, so that a geom costs a few
dot products and a square root or two. The nearest hit is one integer minimum: positive
float32 numbers sort like their bits, and the low bits, replaced by the geom's rank, carry the
winner along. A missed geom gives NaN or a negative distance, whose bits lose by themselves as
unsigned integers. Only the winner is shaded, from two products of its normal.

`docs/renderer.md` has the measurements behind it. It draws the image of
`reference.py`; it has no useful derivative of its own (see `base.py`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.renderer import ground, shading
from pixelbrax_jax.renderer.bounds import at_least, at_most, between
from pixelbrax_jax.renderer.intersect import Axes, Hit, Vector, dot, intersect
from pixelbrax_jax.renderer.shading import SHADOW_BIAS
from pixelbrax_jax.types import Frame, GeomKind, Geoms, Lamp, Look, Scene

_INF_BITS = np.uint32(0x7F800000)


def render(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> Frame:
    """Return a band of rows of an image of the scene.

    Args:
        scene: what to draw.
        height: pixels of the whole image.
        width: pixels.
        first_row: () int, the band's first row; may be traced.
        num_rows: rows of the band.

    Returns:
        The band, every plane (num_rows, W). Its depth is exact to a relative
        ``2**(b - 24)``, where b bits hold a rank.
    """
    to_camera = scene.camera.xmat
    pos = (scene.pos - scene.camera.pos) @ to_camera
    xmat = jnp.einsum("ji,gjk->gik", to_camera, scene.xmat)
    light = None if scene.look.light is None else spatial.unit(scene.look.light) @ to_camera
    lamps = [
        ((lamp.pos - scene.camera.pos) @ to_camera, lamp.axis @ to_camera)
        for lamp in scene.look.lamps
    ]
    pixel = 2.0 * jnp.tan(jnp.deg2rad(scene.camera.fovy) / 2.0) / height
    # The barrier keeps these few numbers out of the loop over pixels.
    pos, xmat, light, lamps, pixel, up, scene = jax.lax.optimization_barrier(
        (pos, xmat, light, lamps, pixel, to_camera[2], scene)
    )
    geoms, look = scene.geoms, scene.look

    # Row after row in one axis: rows would end in pixels that fill no vector and go one by one.
    shape = (num_rows * width,)
    ray = _rays(pixel, height, width, first_row, num_rows)
    # Geoms of one material get neighboring ranks, so that a material is a range of ranks.
    order = sorted(range(len(geoms.kind)), key=lambda g: geoms.material[g])
    solids = [
        _Solid(
            kind=geoms.kind[g],
            center=tuple(pos[g]),
            axes=(tuple(xmat[g, :, 0]), tuple(xmat[g, :, 1]), tuple(xmat[g, :, 2])),
            size=tuple(geoms.size[g]),
            bounded=geoms.is_bounded(g),
            ground=geoms.is_ground(g),
        )
        for g in order
    ]
    hits = [solid.hit(ray, solid.center) for solid in solids]

    t, winner = _nearest(hits, shape)
    seen = [winner == rank for rank in range(len(order))]
    sky = winner == len(order)
    points = tuple(t * component for component in ray)

    color = _surface_colors(geoms, order, winner)
    for rank, solid in enumerate(solids):
        if solid.ground:
            fraction = _ground_fraction(look, ray, hits[rank].t, pixel, solid)
            for c in range(3):
                first, second = look.ground_rgb[0, c], look.ground_rgb[1, c]
                color[c] = jnp.where(seen[rank], first + fraction * (second - first), color[c])

    normal = _Normal(hits, seen, ray)
    n_z = normal.dot((0.0, 0.0, 1.0), ray[2])
    components = (normal.dot((1.0, 0.0, 0.0), ray[0]), normal.dot((0.0, 1.0, 0.0), ray[1]), n_z)
    shade: jax.Array = look.ambient
    gleam: jax.Array | float = 0.0
    on_ground = jnp.zeros(shape, bool)
    for rank, solid in enumerate(solids):
        if solid.ground:
            on_ground |= seen[rank]
    if look.headlight is not None:
        shade += look.headlight * at_least(n_z, 0.0)
        shade = jnp.where(on_ground, at_most(shade, 1.0), shade)
    if light is not None:
        to_light = tuple(light)
        n_l = normal.dot(to_light, dot(ray, to_light))
        lit = jnp.ones(shape, bool)
        if look.shadows:
            for rank, solid in enumerate(solids):
                if solid.kind != GeomKind.PLANE:
                    # A convex geom cannot shade a point of itself that faces the light.
                    there = tuple(c - p for c, p in zip(solid.center, points, strict=True))
                    blocked = solid.hit(to_light, there).t > SHADOW_BIAS
                    lit &= ~(blocked & ~seen[rank])
        gloss = shading.gloss(n_l, n_z, light[2], look.shininess)
        gloss = jnp.where(lit & (n_l > 0.0), gloss, 0.0)
        diffuse = jnp.where(lit, at_least(n_l, 0.0), 0.0)
        shade = shade + look.diffuse * diffuse + look.specular * gloss
        gleam = look.highlight * gloss
    for lamp, place in zip(look.lamps, lamps, strict=True):
        more, glitter = _lamplight(lamp, place, look, points, components, seen, solids)
        shade, gleam = shade + more, gleam + glitter
    if look.headlight is not None:
        # A texture dims the highlight too.
        shade = shade + jnp.where(on_ground, gleam, 0.0)
        gleam = jnp.where(on_ground, 0.0, gleam)

    rise = dot(ray, tuple(up))
    planes = []
    for c in range(3):
        surface = between(0.0, color[c] * shade + gleam, 1.0)
        planes.append(jnp.where(sky, shading.sky(look, rise, c), surface))

    geom_of_rank = jnp.array([*order, -1], jnp.int32)
    depth = jnp.where(sky, jnp.inf, -t * ray[2])
    frame = Frame(
        r=planes[0],
        g=planes[1],
        b=planes[2],
        depth=depth,
        seg=geom_of_rank[winner],
        ground=on_ground,
    )
    return jax.tree.map(lambda plane: plane.reshape(num_rows, width), frame)


class _Solid(NamedTuple):
    """One geom in the camera's frame; fields as in ``intersect``, and whether it is ground."""

    kind: int
    center: Vector
    axes: Axes
    size: Vector
    bounded: bool
    ground: bool

    def hit(self, ray: Vector, center: Vector) -> Hit:
        """Return where rays enter it, with its center at another place."""
        return intersect(self.kind, ray, center, self.axes, self.size, self.bounded)


class _Normal(NamedTuple):
    """The outer unit normal of what each pixel sees; 0 where that is the sky."""

    hits: list[Hit]
    seen: list[jax.Array]
    ray: Vector

    def dot(self, v: Vector, ray_v: jax.Array) -> jax.Array:
        """Return its product with ``v``, given the ray's."""
        product = jnp.zeros(self.ray[0].shape)
        for hit, here in zip(self.hits, self.seen, strict=True):
            product = jnp.where(here, hit.normal_dot(v, ray_v), product)
        return product


def _lamplight(
    lamp: Lamp,
    place: tuple[jax.Array, jax.Array],
    look: Look,
    points: Vector,
    normal: Vector,
    seen: list[jax.Array],
    solids: list[_Solid],
) -> tuple[jax.Array, jax.Array]:
    """Return what a lamp adds to the factor of colors, and to colors themselves."""
    pos, axis = tuple(place[0]), tuple(place[1])
    ray, inv_distance, strength = shading.beam(lamp, pos, axis, points)
    to_lamp = tuple(-component for component in ray)
    n_l = dot(normal, to_lamp)
    strength = jnp.where(n_l > 0.0, strength, 0.0)
    if look.shadows:
        for rank, solid in enumerate(solids):
            if solid.kind != GeomKind.PLANE:
                there = tuple(c - p for c, p in zip(solid.center, pos, strict=True))
                way = solid.hit(ray, there).t
                blocked = (way > 0.0) & ((way + SHADOW_BIAS) * inv_distance < 1.0)
                strength = jnp.where(blocked & ~seen[rank], 0.0, strength)
    shine = shading.gloss(n_l, normal[2], to_lamp[2], look.shininess)
    return strength * lamp.diffuse * n_l, strength * lamp.highlight * shine


def _rays(
    pixel: jax.Array,
    height: int,
    width: int,
    first_row: jax.Array | int,
    num_rows: int,
) -> Vector:
    """Return unit rays through the pixels' centers, camera's frame, row after row from the top."""
    index = jnp.arange(num_rows * width, dtype=jnp.int32)
    row = jax.lax.div(index, np.int32(width)) + first_row
    column = jax.lax.rem(index, np.int32(width))
    x = (column.astype(jnp.float32) - 0.5 * (width - 1)) * pixel
    y = (0.5 * (height - 1) - row.astype(jnp.float32)) * pixel
    inv_length = jax.lax.rsqrt(x * x + y * y + 1.0)
    return x * inv_length, y * inv_length, -inv_length


def _nearest(hits: list[Hit], shape: tuple[int]) -> tuple[jax.Array, jax.Array]:
    """Return distance and rank of the nearest hit; the rank of the sky is ``len(hits)``."""
    rank_bits = np.uint32((1 << len(hits).bit_length()) - 1)
    key = jnp.full(shape, (_INF_BITS & ~rank_bits) | np.uint32(len(hits)), jnp.uint32)
    for rank, hit in enumerate(hits):
        bits = jax.lax.bitcast_convert_type(hit.t, jnp.uint32)
        key = jnp.minimum(key, (bits & ~rank_bits) | np.uint32(rank))
    t = jax.lax.bitcast_convert_type(key & ~rank_bits, jnp.float32)
    return t, (key & rank_bits).astype(jnp.int32)


def _surface_colors(geoms: Geoms, order: list[int], winner: jax.Array) -> list[jax.Array]:
    """Return the winner's own color, one plane a channel. ``order`` must group the materials."""
    materials = [geoms.material[g] for g in order]
    color = [jnp.full(winner.shape, geoms.rgb[materials[0], c]) for c in range(3)]
    for rank in range(1, len(order)):
        if materials[rank] != materials[rank - 1]:
            for c in range(3):
                color[c] = jnp.where(winner >= rank, geoms.rgb[materials[rank], c], color[c])
    return color


def _ground_fraction(
    look: Look, ray: Vector, t: jax.Array, pixel: jax.Array, plane: _Solid
) -> jax.Array:
    """Return the fraction of the ground's second color in pixels that see a plane at ``t``."""
    normal = plane.axes[2]
    slope = 1.0 / at_most(dot(ray, normal), -1e-7)
    inv_pitch = 1.0 / look.ground_pitch
    step = -t * ray[2] * pixel * inv_pitch
    coords, widths = [], []
    for number, (axis, half) in enumerate(zip(plane.axes[:2], plane.size[:2], strict=True)):
        ray_axis = dot(ray, axis)
        along = t * ray_axis - dot(plane.center, axis)
        if plane.bounded:
            # MuJoCo's textures begin at the corner of least x and greatest y.
            along = along + half if number == 0 else half - along
        coords.append(along * inv_pitch)
        # Derivatives of the coordinate by one pixel to the right and one up.
        right = axis[0] - ray_axis * slope * normal[0]
        above = axis[1] - ray_axis * slope * normal[1]
        widths.append(step * (jnp.abs(right) + jnp.abs(above)))
    return ground.second_color_fraction(look.ground, *coords, *widths)
