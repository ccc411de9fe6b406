"""Scene -> frame, by the chosen ray-caster, with a derivative that can be trusted."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.renderer import fused, reference
from pixelbrax_jax.types import Frame, Scene
from pixelbrax_jax.validation import check_choice

RENDERERS = ("fused", "reference")


def render(
    scene: Scene,
    height: int,
    width: int,
    renderer: str = "fused",
    *,
    first_row: jax.Array | int = 0,
    num_rows: int | None = None,
) -> Frame:
    """Draw an image of the scene.

    Colors and depth may be differentiated by everything in the scene that is an array: poses,
    sizes, colors, camera and light. The derivative is finite everywhere. It is that of the
    surface seen at the pixel's center, hence right away from silhouettes, shadow edges and
    the borders between geoms; how those edges move is not in it, nor is the gloss that begins
    or ends where a surface turns to the light. ``seg`` and ``ground`` have none.

    Args:
        scene: what to draw, in the world frame.
        height: pixels, at least 1.
        width: pixels, at least 1.
        renderer: ``"fused"`` or ``"reference"``; same image, other speed.
        first_row: () int, may be traced: first row of the band to draw.
        num_rows: rows of the band; None draws all rows.

    Returns:
        The frame, or its band of rows.

    Raises:
        ValueError: a size below 1 or an unknown renderer.
    """
    for name, value in (("height", height), ("width", width)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1 pixel, got {value}.")
    rows = height if num_rows is None else num_rows
    first_row = jnp.asarray(first_row, jnp.int32)
    if check_choice("renderer", renderer, RENDERERS) == "reference":
        return reference.render(scene, height, width, first_row, rows)
    return _fused(scene, first_row, height, width, rows)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def _fused(scene: Scene, first_row: jax.Array, height: int, width: int, num_rows: int) -> Frame:
    return fused.render(scene, height, width, first_row, num_rows)


@_fused.defjvp
def _fused_jvp(
    height: int, width: int, num_rows: int, primals: tuple, tangents: tuple
) -> tuple[Frame, Frame]:
    scene, first_row = primals

    def floats(scene: Scene) -> Frame:
        return reference.render(scene, height, width, first_row, num_rows).replace(
            seg=None, ground=None
        )

    _, tangent = jax.jvp(floats, (scene,), tangents[:1])
    frame = fused.render(scene, height, width, first_row, num_rows)
    none = np.zeros(frame.seg.shape, jax.dtypes.float0)
    return frame, tangent.replace(seg=none, ground=none)
