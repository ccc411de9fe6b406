"""Networks that map pixels to features, built from fast and deterministic layers."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from pixelbrax_jax.agents.networks.convolution import Before, convolve, unchanged

Layers = tuple[tuple[int, int, int], ...]
"""Channels, size and stride of each convolution."""

Initializer = Callable[..., jax.Array]


def scaled(pixels: jax.Array) -> jax.Array:
    """Scale uint8 pixels to float32 in [0, 1]; a depth of d metres becomes ``1 / (1 + d)``."""
    if pixels.dtype == jnp.float32:
        return 1.0 / (1.0 + pixels)
    return pixels.astype(jnp.float32) / 255.0


def centered(pixels: jax.Array) -> jax.Array:
    """Scale pixels to [-0.5, 0.5]: with positive inputs large steps would turn most filters off."""
    return scaled(pixels) - 0.5


class Conv(nn.Module):
    """A convolution with a bias over channels-last images, like ``flax.linen.Conv``."""

    features: int
    size: int
    stride: int = 1
    padding: str = "VALID"
    kernel_init: Initializer = nn.initializers.lecun_normal()
    before: Before = unchanged

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) to (B, H', W', features); ``before`` changes each number first."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", self.kernel_init, shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        rows, columns = jax.lax.padtype_to_pads(
            x.shape[1:3], shape[:2], (self.stride, self.stride), self.padding
        )
        return convolve(x, kernel, self.stride, (rows, columns), self.before) + bias


def max_pool(x: jax.Array) -> jax.Array:
    """Take 3 x 3 maxima with stride 2; ``nn.max_pool`` is slow and not deterministic on a GPU."""
    height, width = x.shape[1:3]
    pads = jax.lax.padtype_to_pads((height, width), (3, 3), (2, 2), "SAME")
    x = jnp.pad(x, ((0, 0), *pads, (0, 0)), constant_values=-jnp.inf)
    rows, columns = -(-height // 2), -(-width // 2)
    windows = [
        x[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2]
        for i in range(3)
        for j in range(3)
    ]
    return reduce(jnp.maximum, windows)


def orthogonal(gain: float) -> Initializer:
    """Return an initialiser of orthogonal weights."""
    initializer = nn.initializers.orthogonal(gain)

    def sample(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
        # The batched QR decomposition of jaxlib 0.10 can deadlock on a CPU with few cores.
        one_by_one = jax.custom_batching.sequential_vmap(lambda key: initializer(key, shape, dtype))
        return one_by_one(key)

    return sample


def dense(size: int, gain: float = math.sqrt(2.0), name: str | None = None) -> nn.Dense:
    """Make a layer with orthogonal weights."""
    return nn.Dense(size, kernel_init=orthogonal(gain), name=name)


class Impala(nn.Module):
    """The residual network of IMPALA with 15 convolutions (Espeholt et al., arXiv 1802.01561)."""

    @nn.compact
    def __call__(self, pixels: jax.Array) -> jax.Array:
        """Map (B, H, W, C) pixels to (B, 256) features."""
        x = scaled(pixels)
        for channels in (16, 32, 32):
            x = max_pool(Conv(channels, 3, padding="SAME")(x))
            for _ in range(2):
                skip = x
                x = Conv(channels, 3, padding="SAME")(nn.relu(x))
                x = Conv(channels, 3, padding="SAME")(nn.relu(x))
                x = x + skip
        return nn.relu(dense(256)(_flat(nn.relu(x))))


class Stack(nn.Module):
    """Unpadded convolutions of ``before(pixels)``, and a dense layer followed by ``relu``.

    ``bounded`` features are normalised and pass ``tanh`` instead.
    """

    layers: Layers
    features: int
    before: Before = scaled
    bounded: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array) -> jax.Array:
        """Map (B, H, W, C) pixels to (B, F) features."""
        x = dense(self.features)(_convolved(pixels, self.layers, self.before))
        return jnp.tanh(nn.LayerNorm()(x)) if self.bounded else nn.relu(x)


class Convolutions(nn.Module):
    """Centered pixels and convolutions without padding, with orthogonal weights."""

    layers: Layers

    @nn.compact
    def __call__(self, pixels: jax.Array) -> jax.Array:
        """Map (B, H, W, C) pixels to (B, F) features."""
        init = orthogonal(math.sqrt(2.0))
        return _convolved(pixels, self.layers, centered, kernel_init=init)


LAYERS: dict[str, Layers] = {
    # DQN's (Mnih et al., Nature 518, 2015).
    "nature": ((32, 8, 4), (64, 4, 2), (64, 3, 1)),
    # Kostrikov et al., arXiv 2004.13649.
    "drq": ((32, 3, 2), *[(32, 3, 1)] * 3),
    # For small images and slow processors.
    "small": ((16, 4, 2), (32, 4, 2), (32, 3, 1)),
    # First over disjoint patches (Dosovitskiy et al., arXiv 2010.11929).
    "patch": ((32, 4, 4), (32, 2, 2), (32, 3, 1)),
    "patch2": ((32, 4, 4), (32, 2, 2)),
}
"""Convolutions by name of the encoder."""

ENCODERS: dict[str, Callable[[], nn.Module]] = {
    "impala": Impala,
    "nature": partial(Stack, LAYERS["nature"], 512, name="Nature_0"),
    "drq": partial(Stack, LAYERS["drq"], 50, bounded=True, name="DrQ_0"),
    "small": partial(Stack, LAYERS["small"], 128, centered, name="Small_0"),
    "patch": partial(Stack, LAYERS["patch"], 256, centered, name="Patch_0"),
    "patch2": partial(Stack, LAYERS["patch2"], 256, centered, name="Patch2_0"),
}

SMALLEST = {"impala": 1, "nature": 36, "drq": 15, "small": 18, "patch": 24, "patch2": 8}
"""Smallest height and width of each encoder's images in pixels."""


def _convolved(x: jax.Array, layers: Layers, before: Before, **options: Any) -> jax.Array:
    """Apply convolutions as submodules of the calling module; ``before`` acts on ``x``."""
    for channels, size, stride in layers:
        x = nn.relu(Conv(channels, size, stride, before=before, **options)(x))
        before = unchanged
    return _flat(x)


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(x.shape[0], -1)
