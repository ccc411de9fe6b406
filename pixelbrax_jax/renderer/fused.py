"""The fast ray-caster as a program of XLA's: one fused loop over pixels, every geom unrolled.

What is computed for a pixel is in `pixels.py`; `docs/renderer.md` tells why the loop has its form.
It draws the image of `reference.py`; it has no useful derivative of its own (see
`base.py`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.renderer.pixels import rays, see, view_of
from pixelbrax_jax.types import Frame, Scene


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
    # The barrier keeps these few numbers out of the loop over pixels.
    view = jax.lax.optimization_barrier(view_of(scene, height))
    # Row after row in one axis: rows would end in pixels that fill no vector and go one by one.
    index = jnp.arange(num_rows * width, dtype=jnp.int32)
    row = jax.lax.div(index, np.int32(width)) + first_row
    column = jax.lax.rem(index, np.int32(width))
    seen = see(view, rays(view, height, width, row, column))
    geom_of_rank = jnp.array([*view.geom, -1], jnp.int32)
    frame = seen.frame(geom_of_rank[seen.rank])
    return jax.tree.map(lambda plane: plane.reshape(num_rows, width), frame)
