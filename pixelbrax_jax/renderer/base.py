"""Scene -> image, by the chosen ray-caster, with a derivative that can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax._platform.lowering import by_platform
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.renderer import choice, fused, reference
from pixelbrax_jax.types import Frame, Scene
from pixelbrax_jax.validation import check_choice

RENDERERS = ("auto", "fused", "pallas", "reference")

_BANDS = 2
"""Parts in which an accelerator draws an image, one above the other: a loop of one is none."""


def check_renderer(renderer: object) -> str:
    """Return ``renderer`` if it can draw here.

    Raises:
        ValueError: it is unknown, or the default device cannot run it; the message says what can.
    """
    name = check_choice("renderer", renderer, RENDERERS)
    if name == "pallas" and (why := choice.why_not_here()) is not None:
        raise ValueError(
            f"renderer='pallas' is a kernel for NVIDIA GPUs, and {why}. Use 'auto' (the fastest on "
            "every device, this kernel in programs compiled for CUDA) or 'fused'."
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


def draw(
    scene: Scene,
    height: int,
    width: int,
    renderer: str,
    change: Callable[[Frame, jax.Array], Frame],
) -> jax.Array:
    """Draw an image, change it and pack it, as a program computes it once, whoever reads it.

    Without a barrier XLA fuses the renderer into every reader of its image and runs it again for
    each. Nothing is fused into a kernel of its own. Where there is none, control flow is a barrier
    that XLA keeps: on a CPU a conditional, for which a GPU would wait for the host; on a TPU an
    optimization barrier is enough; elsewhere a loop over bands, which also halves what XLA keeps of
    an image that it does not fuse.

    Args:
        scene: what to draw.
        height: pixels.
        width: pixels.
        renderer: one of ``RENDERERS``.
        change: ``change(frame, rows)``, some rows of the image with other colors, given the
            numbers of these rows, (R,) int32. What it does pixel by pixel is part of the kernel.

    Returns:
        (height, width) uint32 packed pixels.
    """
    plain = "fused" if renderer == "auto" else renderer

    def draw_rows(first_row: jax.Array, num_rows: int) -> jax.Array:
        frame = render(scene, height, width, plain, first_row=first_row, num_rows=num_rows)
        return pack(change(frame, jnp.minimum(first_row + jnp.arange(num_rows), height - 1)))

    def in_bands() -> jax.Array:
        num_rows = -(-height // _BANDS)
        first_rows = jnp.arange(_BANDS) * num_rows
        bands = jax.lax.map(lambda first_row: draw_rows(first_row, num_rows), first_rows)
        return bands.reshape(-1, width)[:height]

    def in_a_conditional() -> jax.Array:
        # On a CPU, XLA clears the result of a loop beforehand, and runs in one thread whatever is
        # fused into the writes to it. A conditional costs nothing; were it known to be always
        # taken, the compiler would remove it, and the barrier with it.
        zero = jax.lax.optimization_barrier(jnp.int32(0))
        blank = jnp.zeros(height * width, jnp.uint32)
        # In one axis, as the renderer computes it.
        image = jax.lax.cond(zero == 0, lambda: draw_rows(zero, height).ravel(), lambda: blank)
        return image.reshape(height, width)

    def behind_a_barrier() -> jax.Array:
        # A TPU's compiler keeps it, and keeps less of an image than of its bands in a loop.
        return jax.lax.optimization_barrier(draw_rows(jnp.int32(0), height))

    def by_kernel() -> jax.Array:
        from pixelbrax_jax.renderer import kernel

        return kernel.draw(
            scene, height, width, lambda frame: pack(change(frame, jnp.arange(height)))
        )

    if renderer == "pallas":
        return by_kernel()
    forms = {"cpu": in_a_conditional, "tpu": behind_a_barrier}
    if renderer == "auto" and choice.why_no_kernel() is None:
        forms["cuda"] = by_kernel
    image: jax.Array = by_platform(default=in_bands, **forms)
    return image


def pack(frame: Frame) -> jax.Array:
    """Pack a frame into 32 bits a pixel: red in the low byte, then green, then blue.

    The only place where colors are rounded: each channel is ``floor(255 x + 1/2)``.

    Returns:
        (H, W) uint32.
    """

    def level(plane: jax.Array) -> jax.Array:
        return (plane * 255.0 + 0.5).astype(jnp.uint32)

    return level(frame.r) | level(frame.g) << 8 | level(frame.b) << 16


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4, 5))
def _fast(
    scene: Scene, first_row: jax.Array, height: int, width: int, num_rows: int, renderer: str
) -> Frame:
    def plain() -> Frame:
        return fused.render(scene, height, width, first_row, num_rows)

    def by_kernel() -> Frame:
        from pixelbrax_jax.renderer import kernel

        return kernel.render(scene, height, width, first_row, num_rows)

    if renderer == "pallas":
        return by_kernel()
    if renderer == "fused" or choice.why_no_kernel() is not None:
        return plain()
    frame: Frame = by_platform(cuda=by_kernel, default=plain)
    return frame


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
