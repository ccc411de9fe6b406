"""Which geoms some pixels may see, from spheres around them; ``GeomKind`` says which ones.

A long geom is inside the convex hull of the spheres around its ends, any other inside one sphere.
Along one axis of the image, a sphere at (c, d), d in front of the camera, covers the slopes s
between its two tangents, ``|c - s d| = r sqrt(1 + s^2)``. A convex hull covers what is between.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.renderer.bounds import at_least, at_most
from pixelbrax_jax.renderer.pixels import View
from pixelbrax_jax.types import GeomKind

_GEOMS = 32
"""Geoms of which a word has one bit each."""

_CLOSE = 1.01
"""Radii in front of the camera within which a sphere counts as seen everywhere."""

Window = tuple[tuple[Any, Any] | None, tuple[Any, Any]]
"""Least and greatest slope along the image's x axis, and along y; None for all, else () float32."""


def window_of(
    view: View,
    rows: tuple[jax.Array, jax.Array],
    columns: tuple[jax.Array, jax.Array] | None,
    height: int,
    width: int,
) -> Window:
    """Return the slopes of rays through pixels, and of those beside them.

    Args:
        view: whose pixels they are.
        rows: () int32, the first and the last.
        columns: likewise; None for all.
        height: pixels of the whole image.
        width: pixels.
    """
    top, bottom = (0.5 * (height - 1) - row.astype(jnp.float32) for row in rows)
    along_y = (view.pixel * (bottom - 1.0), view.pixel * (top + 1.0))
    if columns is None:
        return None, along_y
    left, right = (column.astype(jnp.float32) - 0.5 * (width - 1) for column in columns)
    return (view.pixel * (left - 1.0), view.pixel * (right + 1.0)), along_y


def may_see(view: View, window: Window) -> Callable[[int], jax.Array]:
    """Return a function that tells of the geom of a rank whether rays of a window may hit it.

    32 geoms are looked at in one vector, as is right for a GPU.
    """
    count = len(view.geom)
    kinds = [view.kind[view.geom.index(g)] for g in range(count)]
    words = [_word(view, window, kinds, first) for first in range(0, count, _GEOMS)]

    def seen(rank: int) -> jax.Array:
        word, bit = divmod(view.geom[rank], _GEOMS)
        return ((words[word] >> bit) & 1) != 0

    return seen


def _word(view: View, window: Window, kinds: Sequence[int], first: int) -> jax.Array:
    """Return one bit for each of the geoms from ``first`` on."""
    kinds = kinds[first : first + _GEOMS]
    lane = jnp.arange(_GEOMS, dtype=jnp.int32)
    g = first + jnp.minimum(lane, len(kinds) - 1)

    def where(condition: Callable[[GeomKind], bool]) -> jax.Array:
        mask = sum([1 << bit for bit, kind in enumerate(kinds) if condition(GeomKind(kind))])
        return ((np.int32(np.uint32(mask).view(np.int32)) >> lane) & 1) != 0

    size = [view.size[g, k] for k in range(3)]
    long = where(lambda kind: kind.is_long)
    half = jnp.where(long, size[1], 0.0)
    square = size[0] * size[0] + size[1] * size[1] + size[2] * size[2]
    radius = jnp.where(where(lambda kind: kind.reach == "diagonal"), jnp.sqrt(square), size[0])
    largest = at_least(at_least(size[0], size[1]), size[2])
    radius = jnp.where(where(lambda kind: kind.reach == "largest"), largest, radius)

    center = [view.pos[g, k] for k in range(3)]
    arm = [half * view.xmat[g, k, 2] for k in range(3)]
    ends = [[c + sign * a for c, a in zip(center, arm, strict=True)] for sign in (-1.0, 1.0)]
    depths = [-end[2] for end in ends]
    nearest, farthest = at_most(*depths), at_least(*depths)
    inside = jnp.ones(lane.shape, bool)
    for axis, limits in enumerate(window):
        if limits is None:
            continue
        least, greatest = limits
        reach = [_slopes(end[axis], d, radius) for end, d in zip(ends, depths, strict=True)]
        low, high = at_most(reach[0][0], reach[1][0]), at_least(reach[0][1], reach[1][1])
        inside &= (low <= greatest) & (high >= least)
    seen = (farthest > -radius) & ((nearest <= _CLOSE * radius) | inside)
    return jnp.sum(jnp.where(seen, jnp.int32(1) << lane, 0))


def _slopes(c: jax.Array, d: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the slopes of the two tangents, for a sphere that is not close."""
    inv = 1.0 / (d * d - radius * radius)
    root = radius * jnp.sqrt(at_least(c * c + d * d - radius * radius, 0.0))
    return (c * d - root) * inv, (c * d + root) * inv
