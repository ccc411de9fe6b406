"""Scene -> frame, by the chosen ray-caster, with a derivative that can be trusted."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.renderer import fused, kernel, reference
from pixelbrax_jax.types import Frame, Scene
from pixelbrax_jax.validation import check_choice

RENDERERS = ("auto", "fused", "pallas", "pallas-interpret", "reference")


def check_renderer(renderer: object) -> str:
    """Return ``renderer`` if it can draw here.

    Raises:
        ValueError: it is unknown, or the default device cannot run it; the message says what can.
    """
    name = check_choice("renderer", renderer, RENDERERS)
    if name == "pallas":
        why = kernel.obstacle()
        if why is None and jax.default_backend() != "gpu":
            why = f"JAX computes on a {jax.default_backend()}"
        if why is not None:
            raise ValueError(
                f"renderer='pallas' is a kernel for NVIDIA GPUs, and {why}. Use 'auto' (the "
                "fastest on every device, this kernel in programs compiled for CUDA), 'fused', or "
                "'pallas-interpret', which computes the kernel on any device, slowly."
            )
    return name


@under_default_flags
def render(
    scene: Scene,
    height: int,
    width: int,
    renderer: str = "auto",
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
        renderer: one of ``RENDERERS``; same image, other speed. See ``ProgramConfig``.
        first_row: () int, may be traced: first row of the band to draw.
        num_rows: rows of the band; None draws all rows.

    Returns:
        The frame, or its band of rows.

    Raises:
        ValueError: a size below 1, or a renderer that is unknown or cannot draw here.
    """
    for name, value in (("height", height), ("width", width)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1 pixel, got {value}.")
    rows = height if num_rows is None else num_rows
    first_row = jnp.asarray(first_row, jnp.int32)
    if check_renderer(renderer) == "reference":
        return reference.render(scene, height, width, first_row, rows)
    return _fast(scene, first_row, height, width, rows, renderer)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4, 5))
def _fast(
    scene: Scene, first_row: jax.Array, height: int, width: int, num_rows: int, renderer: str
) -> Frame:
    def plain() -> Frame:
        return fused.render(scene, height, width, first_row, num_rows)

    def by_kernel() -> Frame:
        from pixelbrax_jax.renderer import pallas

        interpret = renderer == "pallas-interpret"
        return pallas.render(scene, height, width, first_row, num_rows, interpret=interpret)

    if renderer == "fused" or (renderer == "auto" and kernel.obstacle() is not None):
        return plain()
    if renderer == "auto":
        frame: Frame = lax.platform_dependent(cuda=by_kernel, default=plain)
        return frame
    return by_kernel()


@_fast.defjvp
@under_default_flags
def _fast_jvp(
    height: int, width: int, num_rows: int, renderer: str, primals: tuple, tangents: tuple
) -> tuple[Frame, Frame]:
    scene, first_row = primals

    def floats(scene: Scene) -> Frame:
        return reference.render(scene, height, width, first_row, num_rows).replace(
            seg=None, ground=None
        )

    _, tangent = jax.jvp(floats, (scene,), tangents[:1])
    frame = _fast(scene, first_row, height, width, num_rows, renderer)
    none = np.zeros(frame.seg.shape, jax.dtypes.float0)
    return frame, tangent.replace(seg=none, ground=none)
