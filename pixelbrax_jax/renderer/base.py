"""Rendering with a chosen renderer and the reference's derivative."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax._platform.by_platform import by_platform, in_a_conditional
from pixelbrax_jax.flags import under_environment_flags
from pixelbrax_jax.observations import IMAGES
from pixelbrax_jax.renderer import choice, fused, reference, shading
from pixelbrax_jax.types import Frame, Scene
from pixelbrax_jax.validation import check_choice

RENDERERS = ("auto", "fused", "pallas", "reference")

SAMPLES = (1, 4, 9, 16)
"""Allowed numbers of rays per pixel, the squares of 1 to 4."""

_BANDS = 2
"""Bands of rows that an accelerator renders in a loop. XLA would remove a loop of one."""


def check_renderer(renderer: object) -> str:
    """Return ``renderer``; raise ValueError if it is unknown or does not run on the device."""
    name = check_choice("renderer", renderer, RENDERERS)
    if name == "pallas" and (why := choice.why_not_here()) is not None:
        raise ValueError(
            f"renderer='pallas' is a kernel for NVIDIA GPUs, but {why}. Use 'auto' (the fastest on "
            "every device, and this kernel in programs compiled for CUDA) or 'fused'."
        )
    return name


def check_samples(samples: object) -> int:
    """Return ``samples``; raise an error if it is not one of ``SAMPLES``."""
    if isinstance(samples, bool) or not isinstance(samples, int | np.integer):
        raise TypeError(f"samples must be an integer, got {samples!r}.")
    if samples not in SAMPLES:
        raise ValueError(
            f"samples must be 1, 4, 9 or 16 (2 x 2, 3 x 3 or 4 x 4 rays per pixel), got {samples}."
        )
    return int(samples)


@under_environment_flags
def render(
    scene: Scene,
    height: int,
    width: int,
    renderer: str = "auto",
    *,
    first_row: jax.Array | int = 0,
    num_rows: int | None = None,
    samples: int = 1,
) -> Frame:
    """Render an image of the scene, or a band of its rows.

    Colors and depth may be differentiated by all arrays of the scene: poses, sizes, colors, camera
    and light. The derivative is finite everywhere, and is that of the surface at the pixel's
    center. It ignores the motion of silhouettes, shadow edges and borders between geoms, and the
    highlight's start or end where a surface turns to the light. ``seg`` and ``ground`` have none.

    Args:
        scene: the scene, in the world frame.
        height: pixels, at least 1.
        width: pixels, at least 1.
        renderer: one of ``RENDERERS``; they give the same image. See ``ProgramConfig``.
        first_row: () int, may be traced: first row of the band to render.
        num_rows: rows of the band; None renders all rows.
        samples: rays per pixel, one of ``SAMPLES``: those of an image that is larger by its root.
            Colors are their means, each rounded to 10 bits; depth, ``seg`` and ``ground`` are those
            of the ray through the pixel's center.
    """
    for name, value in (("height", height), ("width", width)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1 pixel, got {value}.")
    rows = height if num_rows is None else num_rows
    first_row = jnp.asarray(first_row, jnp.int32)
    times = math.isqrt(check_samples(samples))
    return _render(scene, first_row, height, width, rows, check_renderer(renderer), times)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4, 5, 6))
def _render(
    scene: Scene,
    first_row: jax.Array,
    height: int,
    width: int,
    num_rows: int,
    renderer: str,
    times: int = 1,
) -> Frame:
    """``render`` with ``times`` by ``times`` samples, compiled for any device."""
    if times > 1:
        frame = _render(scene, first_row, height, width, num_rows, renderer)
        size, first, rows = (height * times, width * times), first_row * times, num_rows * times
        r, g, b = (_shrunk(x, times) for x in _colors(scene, first, *size, rows, renderer))
        return frame.replace(r=r, g=g, b=b)

    def plain(scene: Scene, first_row: jax.Array) -> Frame:
        return fused.render(scene, height, width, first_row, num_rows)

    def by_kernel(scene: Scene, first_row: jax.Array) -> Frame:
        from pixelbrax_jax.renderer import kernel

        return kernel.render(scene, height, width, first_row, num_rows)

    if renderer == "reference":
        return reference.render(scene, height, width, first_row, num_rows)
    if renderer == "pallas":
        return by_kernel(scene, first_row)
    if renderer == "fused" or choice.why_no_kernel() is not None:
        return plain(scene, first_row)
    plane: Any = jax.ShapeDtypeStruct((num_rows, width), jnp.float32)
    seg, ground = plane.update(dtype=jnp.int32), plane.update(dtype=bool)
    like = Frame(r=plane, g=plane, b=plane, depth=plane, seg=seg, ground=ground)
    return by_platform((scene, first_row), like, cuda=by_kernel, default=plain)


@_render.defjvp
@under_environment_flags
def _render_jvp(
    height: int,
    width: int,
    num_rows: int,
    renderer: str,
    times: int,
    primals: tuple,
    tangents: tuple,
) -> tuple[Frame, Frame]:
    scene, first_row = primals

    def floats(scene: Scene) -> Frame:
        frame = large = reference.render(scene, height, width, first_row, num_rows)
        if times > 1:
            size = height * times, width * times
            large = reference.render(scene, *size, first_row * times, num_rows * times)
        r, g, b = (_shrunk(plane, times) for plane in (large.r, large.g, large.b))
        return frame.replace(r=r, g=g, b=b, seg=None, ground=None)

    _, tangent = jax.jvp(floats, (scene,), tangents[:1])
    frame = _render(scene, first_row, height, width, num_rows, renderer, times)
    none = np.zeros(frame.seg.shape, jax.dtypes.float0)
    return frame, tangent.replace(seg=none, ground=none)


def _colors(
    scene: Scene, first_row: jax.Array, height: int, width: int, num_rows: int, renderer: str
) -> list[jax.Array]:
    """Return red, green and blue of a band of rows, one ray per pixel."""
    if renderer == "pallas":
        from pixelbrax_jax.renderer import kernel

        return kernel.colors(scene, height, width, first_row, num_rows)

    def planes() -> list[jax.Array]:
        frame = _render(scene, first_row, height, width, num_rows, renderer)
        return [frame.r, frame.g, frame.b]

    return shading.computed_apart(planes)


def _shrunk(plane: jax.Array, times: int) -> jax.Array:
    """Return the means of blocks of ``times`` by ``times`` pixels."""
    places = [(row, column) for row in range(times) for column in range(times)]
    total = sum([plane[row::times, column::times] for row, column in places], jnp.zeros(()))
    return total / len(places)


def draw(
    scene: Scene,
    height: int,
    width: int,
    renderer: str,
    change: Callable[..., Frame],
    given: tuple[Any, ...] = (),
    images: tuple[str, ...] = ("pixels",),
    samples: int = 1,
    whole: bool = False,
) -> tuple[jax.Array, ...]:
    """Render images of one view, (height, width) each, only once in a program.

    ``pixels`` are packed, uint32; ``change(frame, rows, *given)`` returns rows of the image with
    other colors, for their indices (R,) int32: all of them if it needs the ``whole`` image. Its
    pixelwise part runs in the kernel, if a pixel has one of the ``samples``. ``depth`` and
    ``segmentation`` are ``Frame.depth`` and ``Frame.seg``.

    Without a barrier XLA fuses the renderer into every reader of its image and runs it again for
    each. A Pallas kernel is never fused. Otherwise the barrier is control flow that XLA keeps: a
    conditional on a CPU (a GPU would wait for the host), an optimization barrier on a TPU, and
    elsewhere a loop over bands, which also halves the memory of intermediate images.
    """
    # Without colors no samples are needed.
    samples = samples if "pixels" in images else 1

    def form(
        method: Callable[[_Drawing], tuple[jax.Array, ...]],
    ) -> Callable[[Scene, tuple[Any, ...]], tuple[jax.Array, ...]]:
        def draw_with(scene: Scene, given: tuple[Any, ...]) -> tuple[jax.Array, ...]:
            def changed(frame: Frame, rows: jax.Array) -> Frame:
                return change(frame, rows, *given)

            return method(_Drawing(scene, height, width, renderer, changed, images, samples, whole))

        return draw_with

    if renderer == "pallas":
        return form(_Drawing.by_kernel)(scene, given)
    has_kernel = renderer == "auto" and choice.why_no_kernel() is None
    return by_platform(
        (scene, given),
        tuple(jax.ShapeDtypeStruct((height, width), IMAGES[name].drawn) for name in images),
        cpu=form(_Drawing.conditionally),
        cuda=form(_Drawing.by_kernel) if has_kernel else None,
        tpu=form(_Drawing.behind_a_barrier),
        default=form(_Drawing.in_bands),
    )


@dataclass(frozen=True)
class _Drawing:
    """Images of a view, and the ways to draw them; the attributes are arguments of ``draw``."""

    scene: Scene
    height: int
    width: int
    renderer: str
    change: Callable[[Frame, jax.Array], Frame]
    images: tuple[str, ...]
    samples: int
    whole: bool

    def conditionally(self) -> tuple[jax.Array, ...]:
        # On a CPU, XLA first clears the result of a loop, and runs what is fused into the writes
        # to it in one thread. A conditional costs nothing.
        size = self.height, self.width

        def flat(first_row: jax.Array) -> tuple[jax.Array, ...]:
            # Flat, as the renderer computes it.
            return tuple(image.ravel() for image in self._draw_rows(first_row, self.height))

        like = tuple(
            jax.ShapeDtypeStruct((math.prod(size),), IMAGES[name].drawn) for name in self.images
        )
        return tuple(image.reshape(size) for image in in_a_conditional(flat, like))

    def behind_a_barrier(self) -> tuple[jax.Array, ...]:
        # A TPU's compiler keeps the barrier, which needs less memory than a loop over bands.
        return jax.lax.optimization_barrier(self._draw_rows(jnp.int32(0), self.height))

    def in_bands(self) -> tuple[jax.Array, ...]:
        num_rows = -(-self.height // _BANDS)
        band = self._render_rows if self.whole else self._draw_rows
        first_rows = jnp.arange(_BANDS) * num_rows
        bands: Any = jax.lax.map(lambda first_row: band(first_row, num_rows), first_rows)
        joined = jax.tree.map(lambda x: x.reshape(-1, self.width)[: self.height], bands)
        return self._planes_of(joined, jnp.arange(self.height)) if self.whole else joined

    def by_kernel(self) -> tuple[jax.Array, ...]:
        from pixelbrax_jax.renderer import kernel

        size, rows = (self.height, self.width), jnp.arange(self.height)
        if self.samples > 1:
            times = math.isqrt(self.samples)
            frame = _render(self.scene, jnp.int32(0), *size, self.height, "pallas", times)
            return self._planes_of(frame, rows)
        return kernel.draw(
            self.scene, *size, lambda frame: pack(self.change(frame, rows)), self.images
        )

    def _draw_rows(self, first_row: jax.Array, num_rows: int) -> tuple[jax.Array, ...]:
        rows = jnp.minimum(first_row + jnp.arange(num_rows), self.height - 1)
        return self._planes_of(self._render_rows(first_row, num_rows), rows)

    def _render_rows(self, first_row: jax.Array, num_rows: int) -> Frame:
        return _render(
            self.scene,
            first_row,
            self.height,
            self.width,
            num_rows,
            "fused" if self.renderer == "auto" else self.renderer,
            math.isqrt(self.samples),
        )

    def _planes_of(self, frame: Frame, rows: jax.Array) -> tuple[jax.Array, ...]:
        planes = {"depth": frame.depth, "segmentation": frame.seg}
        if "pixels" in self.images:
            planes["pixels"] = pack(self.change(frame, rows))
        return tuple(planes[name] for name in self.images)


def pack(frame: Frame) -> jax.Array:
    """Pack a frame into (H, W) uint32: red in the low byte, then green, then blue.

    This is the only place that rounds colors: each channel is ``floor(255 x + 1/2)``.
    """

    def level(plane: jax.Array) -> jax.Array:
        return (plane * 255.0 + 0.5).astype(jnp.uint32)

    return level(frame.r) | level(frame.g) << 8 | level(frame.b) << 16
