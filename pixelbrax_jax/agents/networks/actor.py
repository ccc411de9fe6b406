"""Networks: pixels -> features -> a distribution over actions and a value."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from pixelbrax_jax.agents.networks.convolution import Conv
from pixelbrax_jax.agents.networks.distributions import Normal

LOG_STD_RANGE = (-5.0, 2.0)
"""Between which logarithms of standard deviations are kept."""

_ROOT_2 = math.sqrt(2.0)
_GREY = 0.5
"""Taken from pixels in [0, 1] by the encoders that are not published ones. A gradient has the same
sign for all weights of a filter that sees positive numbers only, and large steps then leave most
filters at zero for ever, under videos all of them."""


def max_pool(x: jax.Array) -> jax.Array:
    """Return the maximum over windows of 3 x 3 with stride 2, padded as ``SAME``.

    The windows are nine strided slices. ``nn.max_pool`` gives the same numbers, but its gradient
    is XLA's select-and-scatter, which is slow and on a GPU not deterministic.

    Args:
        x: (B, H, W, C).

    Returns:
        (B, ceil(H / 2), ceil(W / 2), C).
    """
    height, width = x.shape[1:3]
    pads = jax.lax.padtype_to_pads((height, width), (3, 3), (2, 2), "SAME")
    x = jnp.pad(x, ((0, 0), *pads, (0, 0)), constant_values=-jnp.inf)
    rows, columns = -(-height // 2), -(-width // 2)
    windows = [
        x[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2]
        for i in range(3)
        for j in range(3)
    ]
    pooled = windows[0]
    for window in windows[1:]:
        pooled = jnp.maximum(pooled, window)
    return pooled


class Impala(nn.Module):
    """The residual network of IMPALA (Espeholt et al., arXiv 1802.01561), 15 convolutions."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) float32 to (B, 256) features."""
        for channels in (16, 32, 32):
            x = max_pool(Conv(channels, 3, padding="SAME")(x))
            for _ in range(2):
                skip = x
                x = Conv(channels, 3, padding="SAME")(nn.relu(x))
                x = Conv(channels, 3, padding="SAME")(nn.relu(x))
                x = x + skip
        return nn.relu(_dense(256)(_flat(nn.relu(x))))


class Nature(nn.Module):
    """The network of DQN (Mnih et al., Nature 518, 2015)."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) float32 to (B, 512) features."""
        for channels, size, stride in ((32, 8, 4), (64, 4, 2), (64, 3, 1)):
            x = nn.relu(Conv(channels, size, stride)(x))
        return nn.relu(_dense(512)(_flat(x)))


class DrQ(nn.Module):
    """The network of DrQ (Kostrikov et al., arXiv 2004.13649)."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) float32 to (B, 50) features."""
        for stride in (2, 1, 1, 1):
            x = nn.relu(Conv(32, 3, stride)(x))
        return jnp.tanh(nn.LayerNorm()(_dense(50)(_flat(x))))


class Small(nn.Module):
    """Three convolutions for small images and slow processors."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) float32 to (B, 128) features."""
        x = x - _GREY
        for channels, size, stride in ((16, 4, 2), (32, 4, 2), (32, 3, 1)):
            x = nn.relu(Conv(channels, size, stride)(x))
        return nn.relu(_dense(128)(_flat(x)))


class Patch(nn.Module):
    """Three convolutions, the first over patches that do not overlap: little work for each pixel.

    Vision transformers begin with such a layer (Dosovitskiy et al., arXiv 2010.11929).
    """

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map (B, H, W, C) float32 to (B, 256) features."""
        x = x - _GREY
        for channels, size, stride in ((32, 4, 4), (32, 2, 2), (32, 3, 1)):
            x = nn.relu(Conv(channels, size, stride)(x))
        return nn.relu(_dense(256)(_flat(x)))


ENCODERS: dict[str, Callable[[], nn.Module]] = {
    "impala": Impala,
    "nature": Nature,
    "drq": DrQ,
    "small": Small,
    "patch": Patch,
}

SMALLEST = {"impala": 1, "nature": 36, "drq": 15, "small": 18, "patch": 24}
"""Height and width, in pixels, that an encoder needs at least."""

POLICIES = ("gaussian", "tanh_gaussian", "deacrep")


class ActorOutput(struct.PyTreeNode):
    """What an actor says of a batch of observations.

    Attributes:
        policy: the distribution over actions.
        value: (B,) float32 of the actor's own value head; None if it has none.
        features: (B, F) float32 of the encoder.
    """

    policy: Normal
    value: Any
    features: jax.Array


class Actor(nn.Module):
    """Encoder, policy head and, if wanted, a value head.

    Policies:

    * ``"gaussian"``: mean linear in the features, one log standard deviation for each action,
      clipped to [-5, 2]; the environment clips the action.
    * ``"tanh_gaussian"``: the same, and the action is its ``tanh``.
    * ``"deacrep"``: as in Lyu et al.'s code for arXiv 2502.00021: mean ``tanh`` of a linear layer,
      standard deviation ``softplus`` of another one, clipped to [-10, 10], plus 0.001.

    Attributes:
        encoder: name of the encoder.
        action_size: length A of an action.
        policy: name of the policy.
        initial_std: of ``"gaussian"`` and ``"tanh_gaussian"``.
        has_value: whether there is a value head.
    """

    encoder: str
    action_size: int
    policy: str
    initial_std: float = 1.0
    has_value: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array, detach_value: bool = False) -> ActorOutput:
        """Return the policy, and the value.

        Args:
            pixels: (B, H, W, C) uint8.
            detach_value: whether the value's gradient stops before the encoder.
        """
        features = ENCODERS[self.encoder]()(scaled(pixels))
        mean = _dense(self.action_size, 0.01, "mean")(features)
        if self.policy == "deacrep":
            mean = jnp.tanh(mean)
            spread = _dense(self.action_size, 0.01, "spread")(features)
            std = jax.nn.softplus(jnp.clip(spread, -10.0, 2.0)) + 0.001
        else:
            start = nn.initializers.constant(math.log(self.initial_std))
            log_std = self.param("log_std", start, (self.action_size,))
            std = jnp.broadcast_to(jnp.exp(jnp.clip(log_std, *LOG_STD_RANGE)), mean.shape)
        value = None
        if self.has_value:
            seen = jax.lax.stop_gradient(features) if detach_value else features
            value = _dense(1, 1.0, "value")(seen)[..., 0]
        policy = Normal(mean=mean, std=std, squash=self.policy == "tanh_gaussian")
        return ActorOutput(policy=policy, value=value, features=features)


class Critic(nn.Module):
    """The value of pixels, or of the simulator's state.

    Attributes:
        encoder: name of the encoder; unused when the critic sees the state.
        sees_state: whether it sees the state and no pixels.
    """

    encoder: str
    sees_state: bool = False

    @nn.compact
    def __call__(self, pixels: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Return the value.

        Args:
            pixels: (B, H, W, C) uint8.
            state: (B, S) float32, if the critic sees it.

        Returns:
            (B,) float32.
        """
        if self.sees_state:
            # Normalising a first layer's output makes the scale of the state unimportant.
            features = jnp.tanh(nn.LayerNorm()(_dense(256)(state)))
            features = nn.relu(_dense(256)(features))
        else:
            features = ENCODERS[self.encoder]()(scaled(pixels))
        return _dense(1, 1.0, "value")(features)[..., 0]


class Dynamics(nn.Module):
    """Tells whether an action leads from one observation's features to another's."""

    @nn.compact
    def __call__(self, features: jax.Array, action: jax.Array, following: jax.Array) -> jax.Array:
        """Return (B,) logits of (B, F) features, (B, A) unclipped actions and (B, F) features."""
        x = jnp.concatenate([features, action, following], axis=-1)
        for _ in range(2):
            x = nn.relu(_dense(256)(x))
        return _dense(1, 1.0)(x)[..., 0]


def scaled(pixels: jax.Array) -> jax.Array:
    """Return uint8 pixels as encoders take them: float32 in [0, 1]."""
    return pixels.astype(jnp.float32) / 255.0


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(x.shape[0], -1)


def _dense(size: int, gain: float = _ROOT_2, name: str | None = None) -> nn.Dense:
    return nn.Dense(size, kernel_init=_orthogonal(gain), name=name)


def _orthogonal(gain: float) -> Callable[..., jax.Array]:
    """Return Flax's orthogonal matrices, which may be sampled under ``jax.vmap`` too.

    They are Q of a QR decomposition. On a CPU that of a batch waits for threads which others of
    its kind may hold while they wait as well: where cores are few, jaxlib 0.10 then stands still
    for ever. Here a batch is drawn one by one.
    """
    initializer = nn.initializers.orthogonal(gain)

    def draw(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
        one_by_one = jax.custom_batching.sequential_vmap(lambda key: initializer(key, shape, dtype))
        matrix: jax.Array = one_by_one(key)
        return matrix

    return draw
