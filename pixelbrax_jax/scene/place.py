"""Scenes from the poses of links."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.scene import strings
from pixelbrax_jax.scene.cameras import aim
from pixelbrax_jax.types import CameraRig, Geoms, Look, Scene


@under_default_flags
def place(geoms: Geoms, rig: CameraRig, look: Look, xpos: jax.Array, xquat: jax.Array) -> Scene:
    """Move geoms and lamps with their links, hang the strings and aim the camera.

    Link origins ``xpos`` (L, 3) float32 are in metres, and orientations ``xquat`` (L, 4) float32
    are unit quaternions, both in the world frame.
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
        centers, axes, half = strings.pieces(string, jnp.stack(ends), len(rows))
        pos, xmat = pos.at[rows].set(centers), xmat.at[rows].set(axes)
        geoms = geoms.replace(size=jnp.asarray(geoms.size).at[rows, 1].set(half))
    lamps = tuple(
        lamp.replace(pos=lamp.pos + xpos[lamp.link]) if lamp.link >= 0 else lamp
        for lamp in look.lamps
    )
    look = look.replace(lamps=lamps)
    return Scene(geoms=geoms, pos=pos, xmat=xmat, camera=aim(rig, xpos), look=look)
