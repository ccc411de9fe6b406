"""Which changes of an image are made pixel by pixel, and that they come out the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.renderer.base import pack
from pixelbrax_jax.renderer.per_pixel import per_pixel
from pixelbrax_jax.types import Frame

SHAPE = (6, 5)
SHIFT, NOISE = jnp.array([0.1, -0.2, 0.3]), jnp.linspace(0.0, 1.0, 30).reshape(SHAPE)


def frame():
    planes = iter(jax.random.uniform(jax.random.key(0), (4, *SHAPE)))
    seg = jnp.arange(30).reshape(SHAPE) % 4 - 1
    return Frame(next(planes), next(planes), next(planes), next(planes), seg, seg == 0)


def shapes(frame):
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), frame)


def shifted(frame):
    """Reads single numbers of an array, and works out others of them."""
    return frame.replace(r=jnp.clip(frame.r + SHIFT[0], 0, 1), g=frame.g * jnp.sum(SHIFT))


def striped(frame):
    """One row for all rows."""
    return frame.replace(r=frame.r * NOISE[0])


def mixed(frame):
    """Reads an image, chooses by geom and ground, and chooses between constants."""
    kept = jnp.where(frame.ground, 0.25, jnp.where(frame.seg > 1, 1.0, SHIFT[0]))
    return frame.replace(b=kept * frame.b + (1.0 - kept) * NOISE)


def blended(frame):
    """Reads one packed image, and what is computed of its pixels."""
    packed = (NOISE * 2.0**24).astype(jnp.uint32)
    red, green = ((packed >> shift & 0xFF).astype(jnp.float32) / 255.0 for shift in (0, 8))
    return frame.replace(r=jnp.where(red > 0.5, red, frame.r), g=0.5 * (frame.g + green))


@pytest.mark.parametrize(
    ("change", "numbers", "images"),
    [(lambda frame: frame, 0, 0), (shifted, 2, 0), (mixed, 1, 1), (striped, 0, 1), (blended, 0, 1)],
    ids=["none", "shifted", "mixed", "striped", "blended"],
)
def test_pixels_change_one_by_one_as_the_image_does(change, numbers, images):
    whole = frame()
    found = per_pixel(lambda frame: pack(change(frame)), shapes(whole))
    assert len(found.numbers) == numbers
    assert len(found.images) == images
    expected = pack(change(whole))
    block = jax.tree.map(lambda plane: plane.ravel()[7:20], whole)
    part = found.apply(block, found.numbers, [image.ravel()[7:20] for image in found.images])
    np.testing.assert_array_equal(part, expected.ravel()[7:20])


@pytest.mark.parametrize(
    "change",
    [
        lambda frame: frame.replace(r=frame.r[:, ::-1]),
        lambda frame: frame.replace(r=frame.r - frame.r.mean()),
        lambda frame: frame.replace(r=jnp.cumsum(frame.r, axis=1)),
        lambda frame: frame.replace(r=jax.lax.fori_loop(0, 3, lambda _, r: r * 0.9, frame.r)),
        lambda frame: jax.tree.map(jnp.zeros_like, frame),
    ],
    ids=["mirrored", "mean", "sum", "loop", "not of the frame"],
)
def test_other_changes_are_told_apart(change):
    assert per_pixel(lambda frame: pack(change(frame)), shapes(frame())) is None


def test_a_change_may_be_mapped_and_traced():
    whole = frame()

    @jax.jit
    @jax.vmap
    def first_pixels(amount):
        found = per_pixel(lambda frame: pack(frame.replace(r=frame.r * amount)), shapes(whole))
        return found.apply(jax.tree.map(lambda x: x[0], whole), found.numbers, found.images)

    amounts = jnp.array([0.5, 1.0])
    expected = [pack(whole.replace(r=whole.r * amount))[0] for amount in amounts]
    np.testing.assert_array_equal(first_pixels(amounts), np.stack(expected))
