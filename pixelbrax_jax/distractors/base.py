"""The interface of distractors, and chains of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.types import EnvParams, Frame

_OF_EPISODES = ("episode_return", "episode_length", "non_finite")
"""Names in ``Timestep.info`` that are not a distractor's."""


class Distractor:
    """A change of an environment's image, written for ONE environment.

    It is a frozen dataclass of plain numbers and strings, which decide the program. All that varies
    is in the *state*, a pytree that ``reset`` samples for an episode and ``advance`` updates for
    each frame. ``change_params`` acts before the image is rendered, ``change_frame`` after it.

    Attributes:
        kind: name of the distractor; an environment has at most one of each kind.
        stream: unique number of its random stream, folded into an episode's key.
        only_colors: whether it changes only colors; environments without colors reject it.
        one_camera: whether it supports only environments with one camera.
    """

    kind: ClassVar[str]
    stream: ClassVar[int]
    only_colors: ClassVar[bool] = False
    one_camera: ClassVar[bool] = False

    @property
    def whole_image(self) -> bool:
        """Whether ``change_frame`` needs all rows at once: a pixel depends on other rows."""
        return False

    def reset(self, key: jax.Array, params: EnvParams) -> Any:
        """Sample the state at the first frame of an episode."""
        raise NotImplementedError(
            f"{type(self).__name__} needs a method reset(key, params) that returns its state."
        )

    def advance(self, state: Any, key: jax.Array, frame: jax.Array, params: EnvParams) -> Any:
        """Return the state at the next frame, () int32 ``frame`` of its episode, from 0.

        The key is unique for this frame and distractor.
        """
        return state

    def change_params(self, state: Any, params: EnvParams) -> EnvParams:
        """Return the parameters for the frame, such as other colors or another camera."""
        return params

    def backdrop(
        self, state: Any, params: EnvParams, rows: jax.Array, height: int, width: int
    ) -> jax.Array | None:
        """Return (R, width) uint32 packed pixels of an image for ``change_frame``; None for none.

        ``rows``, (R,) int32, are row indices in [0, height).
        """
        return None

    def change_frame(self, state: Any, frame: Frame, backdrop: jax.Array | None) -> Frame:
        """Return some or all rows of the image with other colors in [0, 1].

        ``backdrop`` has the same rows of the backdrop, if any; noise per pixel belongs there.
        """
        return frame

    def info(self, state: Any) -> dict[str, jax.Array]:
        """Return the entries that the state adds to ``Timestep.info``."""
        return {}


def levels(packed: jax.Array) -> list[jax.Array]:
    """Return red, green and blue of uint32 packed pixels, float32 in [0, 255]."""
    return [(packed >> shift & 0xFF).astype(jnp.float32) for shift in (0, 8, 16)]


class Chain:
    """A chain of distractors in the order camera, video, color, others; its state is a tuple."""

    _ORDER = ("camera", "video", "color")

    def __init__(self, distractors: Iterable[object] = ()) -> None:
        """Sort and check the distractors: unique kinds and streams, hashable."""
        links = [_checked(distractor) for distractor in distractors]
        kinds = [distractor.kind for distractor in links]
        for kind in kinds:
            if kinds.count(kind) > 1:
                raise ValueError(f"there are two distractors of kind {kind!r}; give only one.")
        if len({distractor.stream for distractor in links}) < len(kinds):
            raise ValueError(f"the distractors {', '.join(kinds)} must have different streams.")
        known = {kind: place for place, kind in enumerate(self._ORDER)}
        self.links = tuple(sorted(links, key=lambda d: known.get(d.kind, len(known))))

    @property
    def whole_image(self) -> bool:
        """Whether ``change_frame`` needs all rows at once."""
        return any(link.whole_image for link in self.links)

    def reset(self, key: jax.Array, params: EnvParams) -> tuple[Any, ...]:
        """Sample states at the first frame of the episode with this key."""
        return tuple(link.reset(self.key(key, link, 0), params) for link in self.links)

    def advance(
        self, states: tuple[Any, ...], key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> tuple[Any, ...]:
        """Return states at frame ``frame``, at least 1, of the episode with this key."""
        return tuple(
            link.advance(state, self.key(key, link, frame), frame, params)
            for link, state in zip(self.links, states, strict=True)
        )

    def change_params(self, states: tuple[Any, ...], params: EnvParams) -> EnvParams:
        """Return the parameters for the frame."""
        for link, state in zip(self.links, states, strict=True):
            params = link.change_params(state, params)
        return params

    def change_frame(
        self,
        states: tuple[Any, ...],
        params: EnvParams,
        frame: Frame,
        rows: jax.Array,
        height: int,
        width: int,
    ) -> Frame:
        """Return the image's rows with indices (R,) int32 in other colors."""
        for link, state in zip(self.links, states, strict=True):
            backdrop = link.backdrop(state, params, rows, height, width)
            frame = link.change_frame(state, frame, backdrop)
            if not isinstance(frame, Frame):
                raise TypeError(
                    f"change_frame of distractor {link.kind!r} must return a Frame, got a "
                    f"{type(frame).__name__}."
                )
        return frame

    def info(self, states: tuple[Any, ...]) -> dict[str, jax.Array]:
        """Return the entries that all distractors add to ``Timestep.info``."""
        info: dict[str, jax.Array] = {}
        for link, state in zip(self.links, states, strict=True):
            added = link.info(state)
            if taken := sorted(added.keys() & {*info, *_OF_EPISODES}):
                raise ValueError(
                    f"info of distractor {link.kind!r} has {taken[0]!r}, which is taken: give it "
                    "another name."
                )
            info |= added
        return info

    @staticmethod
    def key(key: jax.Array, link: Distractor, frame: jax.Array | int) -> jax.Array:
        """Return a distractor's key at a frame of the episode with this key."""
        return jax.random.fold_in(jax.random.fold_in(key, link.stream), frame)


def _checked(distractor: object) -> Distractor:
    """Return a valid distractor, or raise the errors of ``Chain``."""
    if not isinstance(distractor, Distractor):
        raise TypeError(
            f"expected a Distractor, got {type(distractor).__name__}; only pixelbrax_jax.make "
            "takes names."
        )
    name = type(distractor).__name__
    if not isinstance(getattr(distractor, "kind", None), str):
        raise TypeError(f"{name} needs a kind, a unique name.")
    stream = getattr(distractor, "stream", None)
    if not isinstance(stream, int) or stream < 1:
        raise ValueError(f"{name} needs a stream, a positive integer, got {stream!r}.")
    try:
        hash(distractor)
    except TypeError as error:
        raise TypeError(f"{name} cannot be hashed; make it a frozen dataclass.") from error
    return distractor
