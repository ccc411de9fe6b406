"""Contrast and noise, against formulas in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from pixelbrax_jax.distractors import ImageFilter
from tests.distractors.conftest import episode


def images(distractor, num_frames=3):
    """The (num_frames, H, W, 3) images of an episode, as floats."""
    frames = [timestep.obs[..., -3:] for timestep, *_ in episode(distractor, num_frames)]
    return np.stack(frames).astype(float)


@pytest.fixture(scope="module")
def clean():
    return images(None)


@pytest.mark.parametrize("contrast", [0.0, 0.5])
def test_contrast_moves_colors_towards_grey(clean, contrast):
    expected = 127.5 + contrast * (clean - 127.5)
    # Both images are rounded.
    assert np.abs(images(ImageFilter(contrast=contrast)) - expected).max() <= 1.0


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


@pytest.mark.parametrize("options", [{"contrast": 1.5}, {"noise": -0.1}])
def test_a_size_is_a_fraction(options):
    with pytest.raises(ValueError, match=r"of ImageFilter must lie in \[0, 1\], got"):
        ImageFilter(**options)
