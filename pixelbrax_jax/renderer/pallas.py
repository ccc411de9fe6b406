"""The fast ray-caster as one kernel for NVIDIA GPUs, written in Pallas.

XLA splits the program of `fused.py` on a GPU, for a fusion of its takes only so many operands, and
keeps planes of pixels between the parts. Here the same code (`pixels.py`) is traced into a kernel:
a block of it computes some pixels from references to the scene's numbers, changes their colors if
asked to, and writes each of them once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from pixelbrax_jax.renderer.culling import may_see, window_of
from pixelbrax_jax.renderer.pixels import Near, Seen, View, rays, see, view_of
from pixelbrax_jax.types import Frame, GeomKind, Scene

BLOCK = 256
"""Pixels of a block, some rows of a small image: fewer share the work that is done once a block,
more see more geoms."""

_WARPS = 4

Finish = Callable[[Any, Frame, Any], jax.Array]
"""``finish(state, frame, backdrops)``: packed pixels of a block of an image."""


def draw(
    scene: Scene,
    height: int,
    width: int,
    finish: Finish,
    state: Any = (),
    backdrops: Any = (),
    *,
    interpret: bool = False,
) -> jax.Array:
    """Draw an image as packed pixels. It has no derivative.

    Args:
        scene: what to draw.
        height: pixels.
        width: pixels.
        finish: what becomes of the colors: pixel by pixel, element by element.
        state: tree of arrays for ``finish``, which gets its scalars and, in place of other arrays,
            references, of which it may read numbers: ``array[i, j]``.
        backdrops: tree of (height, width) images for ``finish``, which gets a block of each.
        interpret: compute it on any device by XLA, slowly.

    Returns:
        (height, width) uint32, what ``finish`` gave.
    """

    def pack(view: View, state: Any, backdrops: Any, seen: Seen) -> list[jax.Array]:
        return [finish(state, seen.frame(_geom(view, seen)), backdrops)]

    view = view_of(scene, height, _einsum)
    band = _Band(height, width, 0, height)
    (image,) = _call(pack, view, state, backdrops, band, [jnp.uint32], interpret)
    return image


def render(
    scene: Scene,
    height: int,
    width: int,
    first_row: jax.Array | int = 0,
    num_rows: int | None = None,
    *,
    interpret: bool = False,
) -> Frame:
    """Return a band of rows of an image; see ``fused.render`` and ``draw``."""

    def planes(view: View, state: Any, backdrops: Any, seen: Seen) -> list[jax.Array]:
        del state, backdrops
        return [seen.r, seen.g, seen.b, seen.depth, _geom(view, seen)]

    band = _Band(height, width, first_row, height if num_rows is None else num_rows)
    view = view_of(scene, height, _einsum)
    dtypes = [*[jnp.float32] * 4, jnp.int32]
    r, g, b, depth, seg = _call(planes, view, (), (), band, dtypes, interpret)
    ground = jnp.zeros(seg.shape, bool)
    for geom, is_ground in zip(view.geom, view.ground, strict=True):
        if is_ground:
            ground |= seg == geom
    return Frame(r=r, g=g, b=b, depth=depth, seg=seg, ground=ground)


class _Band(NamedTuple):
    """Rows of an image: its size, the first row, which may be traced, and their number."""

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
        # The block ends in the row in which it begins, or in the next one.
        first, end = (jax.lax.rem(i, width) for i in (start, last))
        one_row = top == bottom
        columns = (jnp.where(one_row, first, 0), jnp.where(one_row, end, width - 1))
    seen = may_see(view, window_of(view, (top, bottom), columns, band.height, band.width))

    def near(rank: int, update: Callable[[Any], Any], value: Any) -> Any:
        if view.kind[rank] == GeomKind.PLANE:
            return update(value)
        return jax.lax.cond(seen(rank), update, lambda value: value, value)

    return near


def _einsum(subscripts: str, a: Any, b: Any) -> jax.Array:
    """Return ``jnp.einsum`` over one axis as a sum, which XLA fuses: products it launches apart."""
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


def _geom(view: View, seen: Seen) -> jax.Array:
    """Return the geom of each pixel: a kernel has no table to look it up in."""
    geom = jnp.full(seen.rank.shape, -1, jnp.int32)
    for rank, of_rank in enumerate(view.geom):
        geom = jnp.where(seen.rank == rank, of_rank, geom)
    return geom


def _call(
    compute: Callable[..., list[jax.Array]],
    view: View,
    state: Any,
    backdrops: Any,
    band: _Band,
    dtypes: Sequence[Any],
    interpret: bool,
) -> list[jax.Array]:
    """Return bands of images, (num_rows, width), from what pixels see.

    Args:
        compute: ``compute(view, state, backdrops, seen)``, blocks of the images.
        view: the scene.
        state: tree of arrays.
        backdrops: tree of bands of images.
        band: which rows.
        dtypes: of the images.
        interpret: see ``draw``.
    """
    height, width, first_row, num_rows = band
    numbers, numbers_tree = jax.tree.flatten((view, state, first_row))
    numbers = [jax.lax.stop_gradient(jnp.asarray(x)) for x in numbers]
    packed = [x.ndim <= 1 and x.dtype == jnp.float32 for x in numbers]
    few, arrays = _parted(numbers, packed)
    # In one array, or XLA would compute them in launches of their own.
    arrays = [jnp.concatenate([x.ravel() for x in few]), *arrays]
    images, images_tree = jax.tree.flatten(backdrops)
    num_pixels = num_rows * width

    def kernel(*refs: Any) -> None:
        of_few, *of_arrays = refs[: len(arrays)]
        of_images = refs[len(arrays) : -len(dtypes)]
        start = pl.program_id(0) * BLOCK
        index = start + jnp.arange(BLOCK, dtype=jnp.int32)
        # The last block has more pixels than are left.
        inside = index < num_pixels
        read, rest = iter(_unpacked(of_few, few)), iter(of_arrays)
        leaves = [next(read) if is_packed else _scalar(next(rest)) for is_packed in packed]
        view, state, first_row = jax.tree.unflatten(numbers_tree, leaves)
        backdrops = jax.tree.unflatten(
            images_tree, [triton.load(ref.at[:], mask=inside, other=0) for ref in of_images]
        )
        row = jax.lax.div(index, np.int32(width)) + first_row
        column = jax.lax.rem(index, np.int32(width))
        last = jnp.minimum(start + BLOCK, num_pixels) - 1
        near = _near(view, band._replace(first_row=first_row), start, last)
        seen = see(view, rays(view, height, width, row, column), near)
        results = compute(view, state, backdrops, seen)
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
        interpret=interpret,
        compiler_params=None
        if interpret
        else triton.CompilerParams(num_warps=_WARPS, num_stages=1),
        name="pixelbrax_draw",
    )(*arrays, *[image.reshape(num_pixels) for image in images])
    return [output.reshape(num_rows, width) for output in outputs]


def _parted(items: Sequence[Any], flags: Sequence[bool]) -> tuple[list[Any], list[Any]]:
    """Return the items with a flag, and those without."""
    pairs = list(zip(items, flags, strict=True))
    return [x for x, flag in pairs if flag], [x for x, flag in pairs if not flag]


def _unpacked(ref: Any, arrays: Sequence[jax.Array]) -> Iterator[Any]:
    """Yield the numbers of arrays that are one after the other in ``ref``: tuples, and scalars."""
    start = 0
    for array in arrays:
        numbers = tuple(ref[start + i] for i in range(array.size))
        yield numbers if array.ndim else numbers[0]
        start += array.size


def _scalar(ref: Any) -> Any:
    """Return the number that a reference to a scalar is to; other references as they are."""
    return ref if ref.shape else ref[()]
