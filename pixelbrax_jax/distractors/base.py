"""The interface of a distractor, and how several work together."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import jax

from pixelbrax_jax.types import EnvParams, Frame


class Distractor:
    """A change of what an environment looks like and of nothing else.

    Written for ONE environment. A distractor is a frozen dataclass of plain numbers and strings,
    for it decides which program is compiled. Whatever varies is in its *state*, a pytree that
    ``reset`` samples at an episode's reset and ``advance`` carries from frame to frame.

    ``change_params`` acts before the image is rendered, ``change_frame`` after. Each is a no-op
    unless it is overridden.

    Attributes:
        kind: name of the distractor; an environment has at most one of a kind.
        stream: name of its random stream, folded into an episode's key; its own for each kind.
    """

    kind: ClassVar[str]
    stream: ClassVar[int]

    def reset(self, key: jax.Array, params: EnvParams) -> Any:
        """Sample the state at the first frame of an episode, by a key of its own."""
        raise NotImplementedError

    def advance(self, state: Any, key: jax.Array, frame: jax.Array, params: EnvParams) -> Any:
        """Return the state at the next frame, () int32 ``frame`` of its episode, 0 first.

        The key is that of this frame and this distractor alone.
        """
        del key, frame, params
        return state

    def change_params(self, state: Any, params: EnvParams) -> EnvParams:
        """Return the parameters to draw the frame with: other colors, another camera."""
        del state
        return params

    def backdrop(
        self, state: Any, params: EnvParams, rows: jax.Array, height: int, width: int
    ) -> jax.Array | None:
        """Return ``rows``, (R,) int32, of an image that ``change_frame`` mixes in.

        They are numbered in [0, height), and are (R, width) uint32 packed pixels; None for none.
        """
        del state, params, rows, height, width
        return None

    def change_frame(self, state: Any, frame: Frame, backdrop: jax.Array | None) -> Frame:
        """Return some rows of the image, or all, with other colors, all in [0, 1].

        ``backdrop`` are the same rows of the backdrop, if there is one. What differs from pixel to
        pixel, such as noise, belongs there.
        """
        del state, backdrop
        return frame

    def info(self, state: Any) -> dict[str, jax.Array]:
        """Return what the state adds to ``Timestep.info``."""
        del state
        return {}


class Chain:
    """Distractors one after the other; of each kind at most one.

    Its state is the tuple of theirs. An image passes them in the order camera, video, color,
    others, whatever the order in which they were given.
    """

    _ORDER = ("camera", "video", "color")

    def __init__(self, distractors: Iterable[object] = ()) -> None:
        """Sort and check.

        Raises:
            ValueError: two are of one kind, or have one stream.
            TypeError: one is no distractor, or cannot be hashed.
        """
        links = [_checked(distractor) for distractor in distractors]
        kinds = [distractor.kind for distractor in links]
        for kind in kinds:
            if kinds.count(kind) > 1:
                raise ValueError(f"there are two distractors of kind {kind!r}; give one of them.")
        if len({distractor.stream for distractor in links}) < len(kinds):
            raise ValueError(f"the distractors {', '.join(kinds)} must differ in their streams.")
        known = {kind: place for place, kind in enumerate(self._ORDER)}
        self.links = tuple(sorted(links, key=lambda d: known.get(d.kind, len(known))))

    def reset(self, key: jax.Array, params: EnvParams) -> tuple[Any, ...]:
        """Sample states at the first frame of the episode that ``key`` stands for."""
        return tuple(link.reset(self._key(key, link, 0), params) for link in self.links)

    def advance(
        self, states: tuple[Any, ...], key: jax.Array, frame: jax.Array, params: EnvParams
    ) -> tuple[Any, ...]:
        """Return states at frame ``frame``, at least 1, of the episode that ``key`` stands for."""
        return tuple(
            link.advance(state, self._key(key, link, frame), frame, params)
            for link, state in zip(self.links, states, strict=True)
        )

    def change_params(self, states: tuple[Any, ...], params: EnvParams) -> EnvParams:
        """Return the parameters to draw with."""
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
        """Return rows of the image with other colors, given (R,) int32, which rows they are."""
        for link, state in zip(self.links, states, strict=True):
            backdrop = link.backdrop(state, params, rows, height, width)
            frame = link.change_frame(state, frame, backdrop)
        return frame

    def info(self, states: tuple[Any, ...]) -> dict[str, jax.Array]:
        """Return what all of them add to ``Timestep.info``."""
        info: dict[str, jax.Array] = {}
        for link, state in zip(self.links, states, strict=True):
            info |= link.info(state)
        return info

    @staticmethod
    def _key(key: jax.Array, link: Distractor, frame: jax.Array | int) -> jax.Array:
        return jax.random.fold_in(jax.random.fold_in(key, link.stream), frame)


def _checked(distractor: object) -> Distractor:
    """Return a distractor, and reject what a program cannot be compiled for.

    Raises:
        TypeError: it is no distractor, or cannot be hashed.
        ValueError: its stream is not a number of its own.
    """
    if not isinstance(distractor, Distractor):
        raise TypeError(
            f"expected a Distractor, got {type(distractor).__name__}; names are for "
            "pixelbrax_jax.make."
        )
    name = type(distractor).__name__
    if not isinstance(getattr(distractor, "kind", None), str):
        raise TypeError(f"{name} needs a kind, a name of its own.")
    stream = getattr(distractor, "stream", None)
    if not isinstance(stream, int) or stream < 1:
        raise ValueError(f"{name} needs a stream, a positive integer, got {stream!r}.")
    try:
        hash(distractor)
    except TypeError as error:
        raise TypeError(f"{name} cannot be hashed; make it a frozen dataclass.") from error
    return distractor
