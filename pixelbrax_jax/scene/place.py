"""Scenes from poses of links, with strings: straight or catenaries, colored beyond their limits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.flags import under_environment_flags
from pixelbrax_jax.scene.cameras import aim
from pixelbrax_jax.spatial import look_at
from pixelbrax_jax.types import CameraRig, Geoms, Look, Scene, String

_NEWTON_STEPS = 8


@under_environment_flags
def place(geoms: Geoms, rig: CameraRig, look: Look, xpos: jax.Array, xquat: jax.Array) -> Scene:
    """Move geoms and lamps with their links, hang the strings and aim the camera.

    Origins ``xpos`` (L, 3), metres, and unit ``xquat`` (L, 4) of links are in the world frame.
    """
    link = np.array(geoms.link, np.int32)
    if len(xpos):
        # No extra row for the world, because a GPU would copy the rows.
        in_world = (link < 0)[:, None]
        link_pos = jnp.where(in_world, 0.0, xpos[link])
        link_quat = jnp.where(in_world, jnp.array([1.0, 0.0, 0.0, 0.0]), xquat[link])
    else:
        link_pos = jnp.zeros((len(link), 3))
        link_quat = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(link), 1))
    pos = link_pos + spatial.rotate(link_quat, geoms.pos)
    xmat = spatial.quat_to_mat(spatial.quat_multiply(link_quat, geoms.quat))
    for string in geoms.strings:
        ends = [
            xpos[link] + spatial.rotate(xquat[link], end) if link >= 0 else end
            for link, end in zip(string.link, string.ends, strict=True)
        ]
        rows = np.array(string.geoms)
        centers, axes, half = _pieces(string, jnp.stack(ends), len(rows))
        pos, xmat = pos.at[rows].set(centers), xmat.at[rows].set(axes)
        geoms = geoms.replace(size=jnp.asarray(geoms.size).at[rows, 1].set(half))
        if string.limits and look.opengl:
            row = geoms.material[string.geoms[0]]
            way = ends[1] - ends[0]
            share = impedance(string, jnp.sqrt(jnp.maximum(jnp.sum(way * way), 1e-12)))
            rgb = jnp.asarray(geoms.rgb)
            color = (1.0 - share) * rgb[row] + share * jnp.array(string.taut_rgb, jnp.float32)
            geoms = geoms.replace(rgb=rgb.at[row].set(color))
    lamps = tuple(
        lamp.replace(pos=lamp.pos + xpos[lamp.link]) if lamp.link >= 0 else lamp
        for lamp in look.lamps
    )
    look = look.replace(lamps=lamps)
    # A rig never turns, so this does not depend on the links.
    turned = None if look.sky_texture is None else look_at(rig.eye, rig.target, rig.up)
    return Scene(geoms, pos, xmat, aim(rig, xpos), look, sky_xmat=turned)


def impedance(string: String, length: jax.Array) -> jax.Array:
    """Return () the impedance of a string's limit at a length () in metres, 0 within its limits.

    MuJoCo computes it from the excess of the length over the limit ("Solver parameters" in its
    documentation): it grows from the first number of ``solimp`` to the second over the width, by
    two powers that meet at the midpoint.
    """
    least, greatest, width, midpoint, power = string.solimp
    low, high = string.limits
    beyond = jnp.maximum(low - length, length - high)
    x = jnp.clip(beyond / width, 0.0, 1.0)
    below = x**power / midpoint ** (power - 1.0)
    above = 1.0 - (1.0 - x) ** power / (1.0 - midpoint) ** (power - 1.0)
    value = least + jnp.where(x <= midpoint, below, above) * (greatest - least)
    # While a string hangs MuJoCo does not show its margin.
    return jnp.where((beyond > 0.0) & (length >= string.length), value, 0.0)


def _pieces(string: String, ends: jax.Array, num: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return ``num`` capsules that cover a string with ends (2, 3) in metres in the world frame.

    Centers are (num, 3), orientations, with z along the string, (num, 3, 3), half lengths (num,).
    """
    points = hang(ends, string.length, num)
    along = points[1:] - points[:-1]
    z = spatial.unit(along)
    # Any direction that is not parallel.
    aside = jnp.where(jnp.abs(z[:, :1]) < 0.9, jnp.eye(3)[0], jnp.eye(3)[1])
    x = spatial.unit(jnp.cross(aside, z))
    half = 0.5 * jnp.sqrt(jnp.maximum(jnp.sum(along * along, -1), 1e-12))
    return 0.5 * (points[1:] + points[:-1]), jnp.stack([x, jnp.cross(z, x), z], axis=-1), half


def hang(ends: jax.Array, length: jax.Array, num: int) -> jax.Array:
    """Return (num + 1, 3) points at equal distances along a string under gravity in -z.

    A catenary is z = a cosh(x / a) + const. With h and v the horizontal and vertical distance of
    its ends and u = h / 2a, its length obeys ``sqrt(length^2 - v^2) / h = sinh(u) / u``, and x / a
    in the middle between the ends is ``artanh(v / length)``. Ends (2, 3) and length () are in
    metres; a string shorter than the distance of its ends is straight.
    """
    start, end = ends[0], ends[1]
    way = end - start
    fraction = jnp.linspace(0.0, 1.0, num + 1)
    straight = start + fraction[:, None] * way
    distance = jnp.sqrt(jnp.maximum(jnp.sum(way * way), 1e-12))
    slack = distance < 0.999 * length
    # For a stretched string: any values with finite derivatives.
    length = jnp.where(slack, length, 1.01 * distance)

    flat = way * jnp.array([1.0, 1.0, 0.0])
    h = jnp.sqrt(jnp.maximum(jnp.sum(flat * flat), (1e-3 * length) ** 2))
    v = jnp.clip(way[2], -0.999 * length, 0.999 * length)
    ratio = jnp.maximum(jnp.sqrt(length * length - v * v) / h, 1.0 + 1e-4)
    u = jnp.sqrt(6.0 * (ratio - 1.0))
    for _ in range(_NEWTON_STEPS):
        excess = u + jnp.log(-jnp.expm1(-2.0 * u) / (2.0 * u)) - jnp.log(ratio)
        u = jnp.maximum(u - excess / (1.0 / jnp.tanh(u) - 1.0 / u), 1e-2)
    a = h / (2.0 * u)
    first = jnp.arctanh(v / length) - u
    place = jnp.arcsinh(jnp.sinh(first) + fraction * length / a)
    along = (place - first) / (2.0 * u)
    height = a * (jnp.cosh(place) - jnp.cosh(first))
    hanging = start + along[:, None] * flat + height[:, None] * jnp.array([0.0, 0.0, 1.0])
    return jnp.where(slack, hanging, straight)
