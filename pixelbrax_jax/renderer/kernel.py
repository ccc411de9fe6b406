"""The fast renderer as one Pallas kernel for NVIDIA GPUs; `docs/renderer.md` explains it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from pixelbrax_jax.observations import IMAGES
from pixelbrax_jax.renderer.fused import Near, see, sky_of
from pixelbrax_jax.renderer.intersect import at_least, at_most
from pixelbrax_jax.renderer.per_pixel import PerPixel, per_pixel
from pixelbrax_jax.renderer.shading import from_words, to_words
from pixelbrax_jax.renderer.view import View, rays, view_of
from pixelbrax_jax.types import Frame, GeomKind, Scene

BLOCK = 256
"""Pixels of a block, some rows of an image: smaller ones share less work, larger see more geoms."""

_WARPS = 4

INTERPRET = False
"""Whether XLA computes the kernel, slowly and on any device; for tests."""

_GEOMS = 32
"""Geoms per word, one bit each."""

_CLOSE = 1.01
"""Distance in radii in front of the camera below which a sphere is never skipped."""

Window = tuple[tuple[Any, Any] | None, tuple[Any, Any]]
"""Least and largest slope along the image's x axis and along y; None for all, else () float32."""


def draw(
    scene: Scene,
    height: int,
    width: int,
    change: Callable[[Frame], jax.Array],
    images: tuple[str, ...] = ("pixels",),
) -> tuple[jax.Array, ...]:
    """Render as ``base.draw``, without a derivative; ``pixels`` are ``change(frame)``, uint32."""
    plane: Any = jax.ShapeDtypeStruct((height, width), jnp.float32)
    seg, ground = plane.update(dtype=jnp.int32), plane.update(dtype=bool)
    by_pixel: PerPixel | None = None
    inputs: tuple[list[jax.Array], list[jax.Array]] = [], []
    if "pixels" in images:
        by_pixel = per_pixel(change, Frame(plane, plane, plane, plane, seg, ground))
        if by_pixel is None:
            frame = render(scene, height, width, 0, height)
            drawn = {"pixels": change(frame), "depth": frame.depth, "segmentation": frame.seg}
            return tuple(drawn[name] for name in images)
        inputs = by_pixel.numbers, by_pixel.images

    def drawn_pixels(numbers: Any, given: Any, frame: Frame) -> list[jax.Array]:
        planes = {"depth": frame.depth, "segmentation": frame.seg}
        if by_pixel is not None:
            planes["pixels"] = by_pixel.apply(frame, numbers, given)
        return [planes[name] for name in images]

    band = _Band(height, width, 0, height)
    return tuple(_call(drawn_pixels, scene, *inputs, band, [IMAGES[name].drawn for name in images]))


def render(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> Frame:
    """Render a band of rows, without a derivative; see ``fused.render``."""

    def planes(_numbers: Any, _images: Any, frame: Frame) -> list[jax.Array]:
        return [frame.r, frame.g, frame.b, frame.depth, frame.seg]

    band = _Band(height, width, first_row, num_rows)
    dtypes = [*[jnp.float32] * 4, jnp.int32]
    r, g, b, depth, seg = _call(planes, scene, (), (), band, dtypes)
    ground = jnp.zeros(seg.shape, bool)
    for geom in filter(scene.geoms.is_ground, range(len(scene.geoms.kind))):
        ground |= seg == geom
    return Frame(r=r, g=g, b=b, depth=depth, seg=seg, ground=ground)


def colors(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> list[jax.Array]:
    """Render red, green and blue of a band of rows, rounded to 10 bits; see ``render``."""

    def words(_numbers: Any, _images: Any, frame: Frame) -> list[jax.Array]:
        return to_words([frame.r, frame.g, frame.b])

    band = _Band(height, width, first_row, num_rows)
    return from_words(_call(words, scene, (), (), band, [jnp.uint32]), 3)


class _Band(NamedTuple):
    """Size of the image, first row of the band, which may be traced, and number of rows."""

    height: int
    width: int
    first_row: jax.Array | int
    num_rows: int


def _near(view: View, band: _Band, start: jax.Array, last: jax.Array) -> Near:
    """Return the argument of ``see`` for the pixels from ``start`` to ``last`` of a band."""
    width = np.int32(band.width)
    top, bottom = (jax.lax.div(i, width) + band.first_row for i in (start, last))
    columns = None
    if band.width >= BLOCK:
        # The block ends in the row where it starts, or in the next one.
        first, end = (jax.lax.rem(i, width) for i in (start, last))
        one_row = top == bottom
        columns = (jnp.where(one_row, first, 0), jnp.where(one_row, end, width - 1))
    seen = may_see(view, window_of(view, (top, bottom), columns, band.height, band.width))

    def near(g: int, update: Callable[[Any], Any], value: Any) -> Any:
        if GeomKind(view.geoms.kind[g]).reach == "all":
            return update(value)
        return jax.lax.cond(seen(g), update, lambda value: value, value)

    return near


def _einsum(subscripts: str, a: Any, b: Any) -> jax.Array:
    """Return ``jnp.einsum`` over one axis as a sum, because XLA does not fuse products."""
    inputs, output = subscripts.split("->")
    (over,) = set(inputs) - {",", *output}
    terms = [
        jnp.expand_dims(
            jnp.einsum(f"{axes}->{''.join(axis for axis in output + over if axis in axes)}", x),
            [place for place, axis in enumerate(output + over) if axis not in axes],
        )
        for axes, x in zip(inputs.split(","), (a, b), strict=True)
    ]
    return jnp.sum(terms[0] * terms[1], axis=-1)


def _geom(view: View, ranks: jax.Array) -> jax.Array:
    """Return the geom of each pixel without a lookup table, which a kernel cannot have."""
    geom = jnp.full(ranks.shape, -1, jnp.int32)
    for rank, g in enumerate(view.order):
        geom = jnp.where(ranks == rank, g, geom)
    return geom


def _call(
    compute: Callable[..., list[jax.Array]],
    scene: Scene,
    numbers: Sequence[jax.Array],
    images: Sequence[jax.Array],
    band: _Band,
    dtypes: Sequence[Any],
) -> list[jax.Array]:
    """Return bands of images, (num_rows, width), from ``compute(numbers, images, frame)``."""
    height, width, first_row, num_rows = band
    texture = sky_of(scene, height, width, first_row, num_rows)
    images = [*images, *texture]
    view = view_of(scene, height, _einsum)
    inputs, inputs_tree = jax.tree.flatten((view, list(numbers), first_row))
    inputs = [jax.lax.stop_gradient(jnp.asarray(x)) for x in inputs]
    packed = [x.ndim <= 1 and x.dtype == jnp.float32 for x in inputs]
    few = [x for x, is_packed in zip(inputs, packed, strict=True) if is_packed]
    others = [x for x, is_packed in zip(inputs, packed, strict=True) if not is_packed]
    # In one array, because XLA would compute each in a separate launch.
    arrays = [jnp.concatenate([x.ravel() for x in few]), *others]
    num_pixels = num_rows * width

    def kernel(*refs: Any) -> None:
        of_few, *of_arrays = refs[: len(arrays)]
        of_images = refs[len(arrays) : -len(dtypes)]
        start = pl.program_id(0) * BLOCK
        index = start + jnp.arange(BLOCK, dtype=jnp.int32)
        # The last block may have more pixels than are left.
        inside = index < num_pixels
        read = _unpacked(of_few, few)
        rest = (ref if ref.shape else ref[()] for ref in of_arrays)
        leaves = [next(read if is_packed else rest) for is_packed in packed]
        view, numbers, first_row = jax.tree.unflatten(inputs_tree, leaves)
        images = [triton.load(ref.at[:], mask=inside, other=0) for ref in of_images]
        row = jax.lax.div(index, np.int32(width)) + first_row
        column = jax.lax.rem(index, np.int32(width))
        last = jnp.minimum(start + BLOCK, num_pixels) - 1
        near = _near(view, band._replace(first_row=first_row), start, last)
        split = len(images) - len(texture)
        frame = see(view, rays(view, height, width, row, column), near, images[split:])
        results = compute(numbers, images[:split], frame.replace(seg=_geom(view, frame.seg)))
        for ref, result in zip(refs[-len(dtypes) :], results, strict=True):
            triton.store(ref.at[:], result, mask=inside)

    block = pl.BlockSpec((BLOCK,), lambda i: (i,))
    whole = [pl.BlockSpec(x.shape, lambda _, x=x: (0,) * x.ndim) for x in arrays]
    outputs = pl.pallas_call(
        kernel,
        grid=(pl.cdiv(num_pixels, BLOCK),),
        in_specs=[*whole, *[block] * len(images)],
        out_specs=[block] * len(dtypes),
        out_shape=[jax.ShapeDtypeStruct((num_pixels,), dtype) for dtype in dtypes],
        interpret=INTERPRET,
        compiler_params=None
        if INTERPRET
        else triton.CompilerParams(num_warps=_WARPS, num_stages=1),
        name="pixelbrax_draw",
    )(*arrays, *[jax.lax.stop_gradient(image).reshape(num_pixels) for image in images])
    return [output.reshape(num_rows, width) for output in outputs]


def _unpacked(ref: Any, arrays: Sequence[jax.Array]) -> Iterator[Any]:
    """Yield tuples and scalars from arrays that are concatenated in ``ref``."""
    start = 0
    for array in arrays:
        numbers = tuple(ref[start + i] for i in range(array.size))
        yield numbers if array.ndim else numbers[0]
        start += array.size


def window_of(
    view: View,
    rows: tuple[jax.Array, jax.Array],
    columns: tuple[jax.Array, jax.Array] | None,
    height: int,
    width: int,
) -> Window:
    """Return the slopes of rays through pixels and their neighbors; None means all columns."""
    top, bottom = (0.5 * (height - 1) - row.astype(jnp.float32) for row in rows)
    along_y = (view.pixel * (bottom - 1.0), view.pixel * (top + 1.0))
    if columns is None:
        return None, along_y
    left, right = (column.astype(jnp.float32) - 0.5 * (width - 1) for column in columns)
    return (view.pixel * (left - 1.0), view.pixel * (right + 1.0)), along_y


def may_see(view: View, window: Window) -> Callable[[int], jax.Array]:
    """Return a function of a geom: whether rays of a window may hit its bounding sphere.

    Along one axis of the image, a sphere at (c, d), d in front of the camera, covers the slopes s
    between its two tangents, ``|c - s d| = r sqrt(1 + s^2)``. A vector holds 32 geoms.
    """
    words = [_word(view, window, first) for first in range(0, len(view.order), _GEOMS)]

    def seen(g: int) -> jax.Array:
        word, bit = divmod(g, _GEOMS)
        return ((words[word] >> bit) & 1) != 0

    return seen


def _word(view: View, window: Window, first: int) -> jax.Array:
    """Return one bit for each of the geoms from ``first`` on."""
    kinds = view.geoms.kind[first : first + _GEOMS]
    lane = jnp.arange(_GEOMS, dtype=jnp.int32)
    g = first + jnp.minimum(lane, len(kinds) - 1)

    def where(condition: Callable[[GeomKind], bool]) -> jax.Array:
        mask = sum([1 << bit for bit, kind in enumerate(kinds) if condition(GeomKind(kind))])
        return ((np.int32(np.uint32(mask).view(np.int32)) >> lane) & 1) != 0

    size = [view.geoms.size[g, k] for k in range(3)]
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
    inv = 1.0 / (d * d - radius * radius)
    root = radius * jnp.sqrt(at_least(c * c + d * d - radius * radius, 0.0))
    return (c * d - root) * inv, (c * d + root) * inv
