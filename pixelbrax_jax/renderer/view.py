"""A scene in its camera's frame, as the fast renderer reads it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax import spatial
from pixelbrax_jax.renderer.intersect import Axes, Fold, Hit, Vector, intersect
from pixelbrax_jax.types import GeomKind, Geoms, Lamp, Look, Scene


class Mirrored(struct.PyTreeNode):
    """Poses, light, lamps and the camera's back axis behind a mirror, in the camera's frame."""

    pos: jax.Array
    xmat: jax.Array
    light: jax.Array | None
    lamps: tuple[Lamp, ...]
    back: jax.Array


class View(struct.PyTreeNode):
    """A scene in its camera's frame, with arrays in the scene's order, shapes and units.

    Attributes:
        order: static, the geom of each rank. Geoms of a material have neighboring ranks: a range.
        pos, xmat: centers and orientations.
        geoms: sizes and colors, without poses.
        look: light and lamps in the camera's frame.
        pixel: () float32, edge of a pixel at distance 1.
        up: (3,) float32, the world's z axis.
        mirrored: the scene behind the plane that reflects; None for none.
    """

    order: tuple[int, ...] = struct.field(pytree_node=False)
    pos: jax.Array
    xmat: jax.Array
    geoms: Geoms
    look: Look
    pixel: jax.Array
    up: jax.Array
    mirrored: Mirrored | None = None


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
    view = View(
        order=tuple(sorted(range(len(geoms.kind)), key=lambda g: geoms.material[g])),
        pos=einsum("gi,ij->gj", scene.pos - scene.camera.pos, to_camera),
        xmat=einsum("ji,gjk->gik", to_camera, scene.xmat),
        geoms=geoms.replace(pos=None, quat=None, strings=()),
        look=look.replace(light=light, lamps=lamps, sky_texture=None),
        pixel=2.0 * jnp.tan(jnp.deg2rad(scene.camera.fovy) / 2.0) / height,
        up=to_camera[2],
    )
    if look.reflectance is None or geoms.mirror < 0:
        return view
    return view.replace(mirrored=_mirrored(view))


def _mirrored(view: View) -> Mirrored:
    look, mirror = view.look, view.geoms.mirror
    normal, base = view.xmat[mirror, :, 2], view.pos[mirror]

    def turned(vectors: jax.Array) -> jax.Array:
        return vectors - 2.0 * jnp.sum(vectors * normal, -1, keepdims=True) * normal

    return Mirrored(
        pos=base + turned(view.pos - base),
        xmat=jnp.swapaxes(turned(jnp.swapaxes(view.xmat, 1, 2)), 1, 2),
        light=None if look.light is None else turned(look.light),
        lamps=tuple(
            lamp.replace(pos=base + turned(lamp.pos - base), axis=turned(lamp.axis))
            for lamp in look.lamps
        ),
        back=turned(jnp.array([0.0, 0.0, 1.0])),
    )


def rays(view: View, height: int, width: int, row: jax.Array, column: jax.Array) -> Vector:
    """Return unit rays through the centers of pixels with the given int32 rows and columns."""
    x = (column.astype(jnp.float32) - 0.5 * (width - 1)) * view.pixel
    y = (0.5 * (height - 1) - row.astype(jnp.float32)) * view.pixel
    inv_length = jax.lax.rsqrt(x * x + y * y + 1.0)
    return x * inv_length, y * inv_length, -inv_length


def surface_colors(view: View, winner: jax.Array) -> list[jax.Array]:
    """Return the colors of geoms by their ranks."""
    rgb, materials = view.geoms.rgb, [view.geoms.material[g] for g in view.order]
    color = [jnp.full(winner.shape, rgb[materials[0], c]) for c in range(3)]
    for rank in range(1, len(materials)):
        if materials[rank] != materials[rank - 1]:
            for c in range(3):
                color[c] = jnp.where(winner >= rank, rgb[materials[rank], c], color[c])
    return color


class Solid(NamedTuple):
    """A geom in the camera's frame."""

    center: Vector
    axes: Axes
    size: Any
    hit: Callable[[Vector, Vector], Hit]
    """Where rays enter it, with its center at another place."""


def solid_of(view: View, g: int, in_kernel: bool) -> Solid:
    """Return a geom; ``in_kernel`` chooses the faster form of a mesh."""
    geoms = view.geoms
    x, y, z = (tuple(view.xmat[g, k, axis] for k in range(3)) for axis in range(3))
    size: Any = tuple(geoms.size[g, k] for k in range(3))
    if geoms.kind[g] == GeomKind.MESH:
        size = _planes(geoms, g, in_kernel)
    hit = partial(
        intersect,
        geoms.kind[g],
        axes=(x, y, z),
        size=size,
        bounded=geoms.is_bounded(g),
        distant=geoms.distant,
    )
    return Solid(tuple(view.pos[g, k] for k in range(3)), (x, y, z), size, hit)


def _planes(geoms: Geoms, g: int, in_kernel: bool) -> Fold:
    first, end = geoms.rows_of_planes(g)
    planes: Any = geoms.planes

    def in_a_loop(prepare: Callable, update: Callable, value: Any) -> Any:
        # Hundreds of planes in a row would take minutes to compile.
        def one(row: jax.Array, value: Any) -> Any:
            return update(value, prepare(tuple(planes[row, k] for k in range(4))))

        return jax.lax.fori_loop(np.int32(first), np.int32(end), one, value)

    def in_a_row(prepare: Callable, update: Callable, value: Any) -> Any:
        # A loop would keep images of all values. The barrier keeps work per plane out of the loop
        # over pixels.
        columns = prepare(tuple(planes[first:end, k] for k in range(4)))
        columns = jax.lax.optimization_barrier(columns)
        for row in range(end - first):
            value = update(value, tuple(column[row] for column in columns))
        return value

    return in_a_loop if in_kernel else in_a_row


def vector(array: Any) -> Vector:
    """Return the three components of an array."""
    return array[0], array[1], array[2]
