"""The sky of a MuJoCo model: three colors, and what its texture adds to them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.spatial import f32

_SKYBOX = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)


def sky_colors(model: mujoco.MjModel) -> Any:
    """Return (3, 3), colors at the horizon, above and below that fit the sky's texture best."""
    texture = _texture(model)
    if texture < 0:
        return f32(np.zeros((3, 3)))
    pixels = texture_pixels(model, texture)
    size = pixels.shape[1]
    if pixels.shape[0] != 6 * size:
        return f32([pixels.reshape(-1, 3).mean(0) / 255.0] * 3)
    step = max(size // 50, 1)
    rise = _rises(size)[:, ::step, ::step].ravel()
    colors = pixels.reshape(6, size, size, 3)[:, ::step, ::step].reshape(-1, 3) / 255.0
    fit, *_ = np.linalg.lstsq(_weights(rise), colors, rcond=None)
    return f32(np.clip(fit, 0.0, 1.0))


def sky_texture(model: mujoco.MjModel, colors: np.ndarray, pixel: float) -> np.ndarray | None:
    """Return ``Look.sky_texture`` of a model whose sky has three ``colors``; None for no sky.

    ``pixel`` is the edge of a pixel at distance 1. Texels are averaged as OpenGL does with linear
    filters between and within the levels of a mipmap, for a camera that looks at the middle of a
    face: each level halves the last one, and the level is log2 of the texels that a pixel covers.
    """
    texture = _texture(model)
    if texture < 0:
        return None
    pixels = texture_pixels(model, texture)
    size = pixels.shape[1]
    # MuJoCo repeats a single face.
    texels = np.broadcast_to(pixels.reshape(-1, size, size, 3), (6, size, size, 3))
    # A level has at least four texels, so that it can be halved once more.
    level = float(np.clip(np.log2(0.5 * size * pixel), 0.0, np.log2(size) - 2.0))
    for _ in range(int(level)):
        texels = _halved(texels)
    blurred = texels.astype(np.float32)
    if level > int(level):
        blurred += np.float32(level - int(level)) * (
            _stretched(_halved(texels), texels.shape[1]) - blurred
        )
    return f32(blurred / 255.0 - _weights(_rises(texels.shape[1])) @ colors)


def texture_pixels(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Return a texture's (H, W, 3) uint8 pixels."""
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    pixels = model.tex_data[first : first + height * width * channels]
    return pixels.reshape(height, width, channels)[..., :3]


def _texture(model: mujoco.MjModel) -> int:
    skies = np.flatnonzero(model.tex_type == _SKYBOX)
    return int(skies[0]) if len(skies) else -1


def _halved(texels: np.ndarray) -> np.ndarray:
    """Return the next level of a mipmap, rounded to uint8."""
    half = texels.shape[1] // 2
    even = texels[:, : 2 * half, : 2 * half].astype(np.uint16)
    rows = even[:, ::2] + even[:, 1::2]
    return ((rows[:, :, ::2] + rows[:, :, 1::2] + 2) // 4).astype(np.uint8)


def _stretched(texels: np.ndarray, size: int) -> np.ndarray:
    """Return a level at another size, linear between its texels."""
    result = texels.astype(np.float32)
    place = np.clip((np.arange(size) + 0.5) * texels.shape[1] / size - 0.5, 0, texels.shape[1] - 1)
    first = np.minimum(place.astype(int), texels.shape[1] - 2)
    share = f32(place - first)
    for axis in (1, 2):
        shares = share.reshape(-1, *[1] * (3 - axis))
        low, high = result.take(first, axis), result.take(first + 1, axis)
        result = low + shares * (high - low)
    return result


def _rises(size: int) -> np.ndarray:
    """Return (6, size, size), the z component of unit rays through a cube map's texels."""
    middle = 2.0 * (np.arange(size) + 0.5) / size - 1.0
    across, down = np.meshgrid(middle, middle)
    length = np.sqrt(across**2 + down**2 + 1.0)
    # Faces are right, left, up, down, front and back, their first rows on top.
    rises = [-down / length, -down / length, 1.0 / length, -1.0 / length]
    return np.stack([*rises, *rises[:2]])


def _weights(rise: np.ndarray) -> np.ndarray:
    """Return (..., 3), the shares of the sky's three colors."""
    return np.stack([1.0 - np.abs(rise), np.maximum(rise, 0.0), np.maximum(-rise, 0.0)], -1)
