"""Several rays per pixel: an image is the mean of one that is larger."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import EnvConfig, make_look
from pixelbrax_jax.renderer.base import draw, pack, render
from tests.renderer.scenes import random_scene

HEIGHT, WIDTH = 8, 10
SCENE = random_scene(1, make_look("default", shadows=True))


def rgb(frame):
    return np.stack([frame.r, frame.g, frame.b], axis=-1)


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize(
    ("renderer", "times"),
    [
        ("fused", 2),
        pytest.param("fused", 3, marks=pytest.mark.slow),
        pytest.param("reference", 2, marks=pytest.mark.slow),
        pytest.param("pallas", 2, marks=pytest.mark.slow),
    ],
)
def test_colors_are_means_of_a_larger_image(renderer, times):
    small = render(SCENE, HEIGHT, WIDTH, renderer, samples=times**2)
    large = render(SCENE, HEIGHT * times, WIDTH * times, renderer)
    means = rgb(large).reshape(HEIGHT, times, WIDTH, times, 3).mean((1, 3))
    np.testing.assert_allclose(rgb(small), means, atol=6e-4)  # 10 bits
    band = render(SCENE, HEIGHT, WIDTH, renderer, first_row=3, num_rows=2, samples=times**2)
    np.testing.assert_allclose(rgb(band), rgb(small)[3:5], atol=1e-3)
    # All else is that of one ray, and some pixels are at edges.
    one = render(SCENE, HEIGHT, WIDTH, renderer)
    for name in ("depth", "seg", "ground"):
        np.testing.assert_array_equal(getattr(small, name), getattr(one, name))
    assert np.abs(rgb(one) - rgb(small)).max() > 0.1


def test_packed_images_have_samples_too():
    whole = render(SCENE, HEIGHT, WIDTH, "fused", samples=4)
    (packed,) = draw(SCENE, HEIGHT, WIDTH, "fused", lambda frame, rows: frame, samples=4)
    levels = [np.asarray(image).view(np.uint8).astype(int) for image in (packed, pack(whole))]
    assert np.abs(levels[0] - levels[1]).max() <= 1


@pytest.mark.slow
def test_the_gradient_is_the_mean_of_gradients():
    def brightness(ambient, height, width, samples):
        scene = SCENE.replace(look=SCENE.look.replace(ambient=ambient))
        return jnp.mean(render(scene, height, width, samples=samples).g)

    ambient = jnp.float32(SCENE.look.ambient)
    small = jax.grad(brightness)(ambient, HEIGHT, WIDTH, 4)
    large = jax.grad(brightness)(ambient, 2 * HEIGHT, 2 * WIDTH, 1)
    assert small == pytest.approx(float(large), rel=1e-4)
    assert small > 0


@pytest.mark.parametrize("samples", [0, 2, 3, 10_000, -4])
def test_only_squares_up_to_16_are_allowed(samples):
    message = f"samples must be 1, 4, 9 or 16 .*, got {samples}"
    with pytest.raises(ValueError, match=message):
        render(SCENE, HEIGHT, WIDTH, samples=samples)
    with pytest.raises(ValueError, match=message):
        EnvConfig(samples=samples)


@pytest.mark.parametrize("samples", [True, 4.0, "4", None])
def test_samples_are_an_integer(samples):
    with pytest.raises(TypeError, match="samples must be an integer, got"):
        EnvConfig(samples=samples)
