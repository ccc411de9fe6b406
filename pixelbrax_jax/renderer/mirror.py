"""What a plane reflects in MuJoCo's OpenGL renderer, for any block of pixels.

MuJoCo draws the other geoms mirrored at the plane, without shadows, with their colors times the
plane's reflectance but their highlights whole, and adds the plane to that. It draws nothing of what
is behind the plane, and no sky.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.renderer.intersect import Vector, between
from pixelbrax_jax.renderer.opengl import lights_of
from pixelbrax_jax.renderer.view import View, solid_of, surface_colors, vector

_INF_BITS = np.uint32(0x7F800000)


def reflection(view: View, ray: Vector, t: jax.Array, in_kernel: bool) -> list[jax.Array]:
    """Return the color that each pixel would get if it saw the mirror at distance ``t``.

    Behind the mirror the pixel's ray meets the mirrored geoms. Other ground is not reflected.
    """
    mirrored, geoms = view.mirrored, view.geoms
    assert mirrored is not None
    behind = view.replace(pos=mirrored.pos, xmat=mirrored.xmat)
    count, shape = len(view.order), ray[0].shape
    hits = {}
    for rank, g in enumerate(view.order):
        if g != geoms.mirror and not geoms.is_ground(g):
            solid = solid_of(behind, g, in_kernel)
            hits[rank] = solid.hit(ray, solid.center)
    bits = np.uint32((1 << count.bit_length()) - 1)
    key = jnp.full(shape, (_INF_BITS & ~bits) | np.uint32(count), jnp.uint32)
    for rank, hit in hits.items():
        # False for NaN. A geom in the plane is cut there, and its inside is not seen.
        distance = jnp.where(hit.t > t, hit.t, -1.0)
        word = jax.lax.bitcast_convert_type(distance, jnp.uint32)
        key = jnp.minimum(key, (word & ~bits) | np.uint32(rank))
    distance = jax.lax.bitcast_convert_type(key & ~bits, jnp.float32)
    winner = (key & bits).astype(jnp.int32)
    normal = [jnp.zeros(shape)] * 3
    matte = jnp.zeros(shape, bool)
    for rank, hit in hits.items():
        here = winner == rank
        for k in range(3):
            axis = tuple(float(k == j) for j in range(3))
            normal[k] = jnp.where(here, hit.normal_dot(axis, ray[k]), normal[k])
        if geoms.textured and geoms.textured[view.order[rank]]:
            matte |= here
    look = view.look.replace(light=mirrored.light, lamps=mirrored.lamps)
    points = tuple(distance * component for component in ray)
    factors = [light(ray, points, normal) for light in lights_of(look, vector(mirrored.back))]
    shade = view.look.reflectance * sum(factor for factor, _ in factors)
    highlight = jnp.where(matte, 0.0, sum(shine for _, shine in factors))
    return [
        jnp.where(winner < count, between(0.0, channel * shade + highlight, 1.0), 0.0)
        for channel in surface_colors(view, winner)
    ]
