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

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.renderer import ground
from pixelbrax_jax.renderer.bounds import at_least, at_most, between
from pixelbrax_jax.renderer.intersect import Axes, Hit, Vector, dot, intersect
from pixelbrax_jax.types import Frame, GeomKind, Geoms, Look, Scene

_INF_BITS = np.uint32(0x7F800000)

_SHADOW_BIAS = 1e-3
"""Metres that a shadow ray must travel before a hit counts."""


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
    geoms, look = scene.geoms, scene.look
    to_camera = scene.camera.xmat
    pos = (scene.pos - scene.camera.pos) @ to_camera
    xmat = jnp.einsum("ji,gjk->gik", to_camera, scene.xmat)
    light = spatial.unit(look.light) @ to_camera
    pixel = 2.0 * jnp.tan(jnp.deg2rad(scene.camera.fovy) / 2.0) / height
    # The barrier keeps these few numbers out of the loop over pixels.
    pos, xmat, light, pixel, up, scene = jax.lax.optimization_barrier(
        (pos, xmat, light, pixel, to_camera[2], scene)
    )
    geoms, look = scene.geoms, scene.look

    # Row after row in one axis: rows would end in pixels that fill no vector and go one by one.
    shape = (num_rows * width,)
    ray = _rays(pixel, height, width, first_row, num_rows)
    # Geoms of one material get neighboring ranks, so that a material is a range of ranks.
    order = sorted(range(len(geoms.kind)), key=lambda g: geoms.material[g])
    kinds = [geoms.kind[g] for g in order]
    centers: list[Vector] = [tuple(pos[g]) for g in order]
    axes: list[Axes] = [
        (tuple(xmat[g, :, 0]), tuple(xmat[g, :, 1]), tuple(xmat[g, :, 2])) for g in order
    ]
    sizes: list[Vector] = [tuple(geoms.size[g]) for g in order]
    geometry = list(zip(kinds, centers, axes, sizes, strict=True))
    hits = [intersect(kind, ray, at, along, size) for kind, at, along, size in geometry]

    t, winner = _nearest(hits, shape)
    seen = [winner == rank for rank in range(len(order))]
    sky = winner == len(order)

    to_light, z_axis = tuple(light), (0.0, 0.0, 1.0)
    ray_light = dot(ray, to_light)
    n_l = n_z = jnp.zeros(shape)
    for hit, here in zip(hits, seen, strict=True):
        n_l = jnp.where(here, hit.normal_dot(to_light, ray_light), n_l)
        n_z = jnp.where(here, hit.normal_dot(z_axis, ray[2]), n_z)
    lit = jnp.ones(shape, bool)
    if look.shadows:
        points = tuple(t * component for component in ray)
        for rank, kind in enumerate(kinds):
            if kind != GeomKind.PLANE:
                # A convex geom cannot shade a point of itself that faces the light.
                there = tuple(c - p for c, p in zip(centers[rank], points, strict=True))
                blocked = intersect(kind, to_light, there, axes[rank], sizes[rank]).t > _SHADOW_BIAS
                lit &= ~(blocked & ~seen[rank])

    color = _surface_colors(geoms, order, winner)
    for rank, kind in enumerate(kinds):
        if kind == GeomKind.PLANE:
            fraction = _ground_fraction(look, ray, hits[rank].t, pixel, centers[rank], axes[rank])
            for c in range(3):
                first, second = look.ground_rgb[0, c], look.ground_rgb[1, c]
                color[c] = jnp.where(seen[rank], first + fraction * (second - first), color[c])

    gloss = at_least(2.0 * n_l * n_z - light[2], 0.0) ** look.shininess
    gloss = jnp.where(lit & (n_l > 0.0), gloss, 0.0)
    diffuse = jnp.where(lit, at_least(n_l, 0.0), 0.0)
    shade = look.ambient + look.diffuse * diffuse + look.specular * gloss
    rise = between(0.0, dot(ray, tuple(up)), 1.0)
    planes = []
    for c in range(3):
        surface = between(0.0, color[c] * shade + look.highlight * gloss, 1.0)
        air = look.sky[0, c] + rise * (look.sky[1, c] - look.sky[0, c])
        planes.append(jnp.where(sky, air, surface))

    geom_of_rank = jnp.array([*order, -1], jnp.int32)
    depth = jnp.where(sky, jnp.inf, -t * ray[2])
    on_plane = jnp.zeros(shape, bool)
    for rank, kind in enumerate(kinds):
        if kind == GeomKind.PLANE:
            on_plane |= seen[rank]
    frame = Frame(
        r=planes[0],
        g=planes[1],
        b=planes[2],
        depth=depth,
        seg=geom_of_rank[winner],
        ground=on_plane,
    )
    return jax.tree.map(lambda plane: plane.reshape(num_rows, width), frame)


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
    look: Look,
    ray: Vector,
    t: jax.Array,
    pixel: jax.Array,
    center: Vector,
    axes: Axes,
) -> jax.Array:
    """Return the fraction of the ground's second color in pixels that see a plane at ``t``."""
    normal = axes[2]
    slope = 1.0 / at_most(dot(ray, normal), -1e-7)
    inv_pitch = 1.0 / look.ground_pitch
    step = -t * ray[2] * pixel * inv_pitch
    coords, widths = [], []
    for axis in axes[:2]:
        ray_axis = dot(ray, axis)
        coords.append((t * ray_axis - dot(center, axis)) * inv_pitch)
        # Derivatives of the coordinate by one pixel to the right and one up.
        right = axis[0] - ray_axis * slope * normal[0]
        above = axis[1] - ray_axis * slope * normal[1]
        widths.append(step * (jnp.abs(right) + jnp.abs(above)))
    return ground.second_color_fraction(look.ground, *coords, *widths)
