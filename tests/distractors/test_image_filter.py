"""Blur, contrast and noise, against formulas in NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.distractors import ImageFilter
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.renderer import base
from tests.distractors.conftest import SIZE, episode
from tests.envs.toy import PARAMS, Ball


def images(distractor, num_frames=3):
    """The (num_frames, H, W, 3) images of an episode, as floats."""
    frames = [timestep.obs[..., -3:] for timestep, *_ in episode(distractor, num_frames)]
    return np.stack(frames).astype(float)


@pytest.fixture(scope="module")
def clean():
    return images(None)


@pytest.mark.parametrize("contrast", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_contrast_moves_colors_towards_grey(clean, contrast):
    expected = 127.5 + contrast * (clean - 127.5)
    # Both images are rounded.
    assert np.abs(images(ImageFilter(contrast=contrast)) - expected).max() <= 1.0


@pytest.mark.parametrize("blur", [pytest.param(0.02, marks=pytest.mark.slow), 0.1])
def test_blur_is_a_mean_with_gaussian_weights(clean, blur):
    scale = blur * clean.shape[1]
    reach = int(np.ceil(3 * scale))
    weights = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * scale**2))
    weights /= weights.sum()
    expected = np.zeros_like(clean)
    height, width = clean.shape[1:3]
    for row in range(height):
        for column in range(width):
            rows = np.clip(np.arange(row - reach, row + reach + 1), 0, height - 1)
            columns = np.clip(np.arange(column - reach, column + reach + 1), 0, width - 1)
            part = clean[:, rows][:, :, columns]
            expected[:, row, column] = np.einsum("i,j,nijc->nc", weights, weights, part)
    assert np.abs(expected - clean).max() > 10
    # Both images are rounded.
    assert np.abs(images(ImageFilter(blur=blur)) - expected).max() <= 1.0


def test_an_image_that_is_drawn_in_bands_is_blurred_whole(monkeypatch):
    env = PixelEnv(Ball(), **SIZE, renderer="fused", distractors=(ImageFilter(blur=0.05),))
    state, _ = env.reset(jax.random.key(0), PARAMS)
    expected = env.draw(state.sim, PARAMS)

    def elsewhere(operands, like, *, default, **_):
        return default(*operands)

    monkeypatch.setattr(base, "by_platform", elsewhere)
    bands = env.draw(state.sim, PARAMS)
    np.testing.assert_array_equal(bands, expected)


def test_colors_have_derivatives_through_a_blur():
    env = PixelEnv(Ball(), **SIZE, distractors=(ImageFilter(blur=0.05),))
    state, _ = env.reset(jax.random.key(0), PARAMS)

    def red(rgb):
        changed = PARAMS.replace(geoms=PARAMS.geoms.replace(rgb=rgb))
        return env.render(state, changed).r.sum()

    rgb = jnp.asarray(PARAMS.geoms.rgb) * 0.5
    slope = jax.grad(red)(rgb)
    change = jnp.zeros_like(rgb).at[:, 0].set(1e-2)
    numeric = (red(rgb + change) - red(rgb - change)) / 2e-2
    assert slope[:, 0].sum() > 1
    np.testing.assert_allclose(slope[:, 0].sum(), numeric, rtol=0.02)


def test_noise_is_uniform_and_new_in_every_pixel_channel_and_frame(clean):
    noise = images(ImageFilter(noise=0.1)) - clean
    assert np.abs(noise).max() <= 0.1 * 255 + 1
    # Where colors are not clipped.
    inside = ((clean > 30) & (clean < 225)).all(0)
    assert inside.mean() > 0.3
    first, second, third = noise[:, inside]
    for one in (first, second, third):
        assert abs(one.mean()) < 1.5
        # That of a uniform variable.
        np.testing.assert_allclose(one.std(), 0.2 * 255 / np.sqrt(12), rtol=0.05)
    pixels = noise[0][inside.all(-1)]
    pairs = [(first, second), (second, third), (pixels[:, 0], pixels[:, 1])]
    pairs.append((pixels[1:, 0], pixels[:-1, 0]))
    for one, other in pairs:
        assert abs(np.corrcoef(one, other)[0, 1]) < 5 / np.sqrt(len(one))


def test_blur_is_bounded():
    with pytest.raises(ValueError, match=r"blur of ImageFilter must lie in \[0, 0.1\], got 0.2"):
        ImageFilter(blur=0.2)
    with pytest.raises(ValueError, match=r"blur of ImageFilter must be a finite number, got '0.1'"):
        ImageFilter(blur="0.1")


@pytest.mark.parametrize("options", [{"contrast": 1.5}, {"noise": -0.1}])
def test_a_size_is_a_fraction(options):
    with pytest.raises(ValueError, match=r"of ImageFilter must lie in \[0, 1\], got"):
        ImageFilter(**options)
