"""Build the Gymnasium spaces of pixel environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_differing_spaces, iterate

from pixelbrax_jax.observations import MAX_DEPTH


class BroadcastBox(gymnasium.spaces.Box):
    """A batched ``Box`` whose bounds are read-only views of one lower and one upper number.

    It equals an ordinary ``Box``, whose bounds for 4096 stacks of 84x84 frames take a gigabyte.
    """

    def __init__(self, low: float, high: float, shape: tuple[int, ...], dtype: Any) -> None:
        super().__init__(low, high, (1,), dtype)
        self._shape = tuple(shape)
        self.low_repr, self.high_repr = str(self.low[0]), str(self.high[0])
        for name in ("low", "high", "bounded_below", "bounded_above"):
            setattr(self, name, np.broadcast_to(getattr(self, name)[0], self._shape))

    def __reduce__(self) -> Any:
        """Pickle or copy two numbers, and the generator of samples."""
        bounds = self.low.flat[0], self.high.flat[0]
        generator = {"_np_random": self._np_random}
        return BroadcastBox, (*bounds, self._shape, self.dtype), generator

    def __eq__(self, other: object) -> bool:
        if isinstance(other, BroadcastBox):
            return (
                self.shape == other.shape
                and self.dtype == other.dtype
                and (self.low_repr, self.high_repr) == (other.low_repr, other.high_repr)
            )
        return super().__eq__(other)

    __hash__ = None  # type: ignore[assignment]  # as in Gymnasium's spaces


# Gymnasium looks up the exact class, not its bases.
batch_differing_spaces.register(BroadcastBox, batch_differing_spaces.dispatch(gymnasium.spaces.Box))
iterate.register(BroadcastBox, iterate.dispatch(gymnasium.spaces.Box))


def observation_space(spec: Any, num_envs: int | None = None) -> gymnasium.Space:
    """Return the space of an observation, a ``Dict`` of several; batched with ``num_envs``."""
    if isinstance(spec, dict):
        return gymnasium.spaces.Dict(
            {name: observation_space(part, num_envs) for name, part in spec.items()}
        )
    return _batched(*_bounds(spec), spec.shape, spec.dtype, num_envs)


def action_space(action_size: int, num_envs: int | None = None) -> gymnasium.spaces.Box:
    """Return the space of an action, float32 in [-1, 1], batched if ``num_envs`` is given."""
    return _batched(-1.0, 1.0, (action_size,), np.float32, num_envs)


def channels_first_space(space: gymnasium.Space) -> gymnasium.Space:
    """Change images in an observation space from (H, W, C) to (C, H, W)."""
    if isinstance(space, gymnasium.spaces.Dict):
        return gymnasium.spaces.Dict(
            {name: channels_first_space(part) for name, part in space.spaces.items()}
        )
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 3:
        return space
    height, width, channels = space.shape
    bounds = space.low.flat[0], space.high.flat[0]
    return gymnasium.spaces.Box(*bounds, (channels, height, width), space.dtype)


def _bounds(spec: Any) -> tuple[float, float]:
    if spec.dtype == np.uint8:
        return 0, 255
    if spec.dtype == np.int32:
        return -1, np.iinfo(np.int32).max
    return (0.0, MAX_DEPTH) if len(spec.shape) == 3 else (-np.inf, np.inf)


def _batched(
    low: float, high: float, shape: tuple[int, ...], dtype: Any, num_envs: int | None
) -> gymnasium.spaces.Box:
    if num_envs is None:
        return gymnasium.spaces.Box(low, high, shape, dtype)
    return BroadcastBox(low, high, (num_envs, *shape), dtype)
