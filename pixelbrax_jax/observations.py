"""Parts of an observation: images of cameras, and the task's state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from pixelbrax_jax.validation import check_choice, check_positive_int


class Image(NamedTuple):
    """An image: channels per camera, dtype, and dtype when drawn, all channels in one number."""

    channels: int
    dtype: str
    drawn: str


IMAGES = {
    "pixels": Image(3, "uint8", "uint32"),
    "depth": Image(1, "float32", "float32"),
    "segmentation": Image(1, "int32", "int32"),
}
"""Images by name, in the order of an observation's entries."""


def image_of(entry: str) -> Image:
    """Return the image of an observation's entry, such as ``depth`` or ``depth/top``."""
    return IMAGES[entry.split("/")[0]]


PARTS = (*IMAGES, "state")
"""Names that ``obs_mode`` may join."""

MAX_DEPTH = 100.0
"""Largest depth of an observation in metres, also that of the sky."""


CameraSizes = Mapping[str, tuple[int, int]] | tuple[tuple[str, int, int], ...]
"""Heights and widths by camera, or rows of name, height and width."""


def check_camera_sizes(value: Any) -> tuple[tuple[str, int, int], ...]:
    """Return ``camera_sizes`` as rows."""
    if isinstance(value, Mapping):
        value = [(name, *_items(size)) for name, size in value.items()]
    rows = [_items(row) for row in _items(value)]
    if not all(len(row) == 3 and isinstance(row[0], str) and row[0] for row in rows):
        raise ValueError(
            "camera_sizes must have a height and a width by the name of each camera, such as "
            f"{{'front': (84, 84), 'top': (48, 64)}}, got {value!r}."
        )
    names = [row[0] for row in rows]
    if len(set(names)) < len(names):
        raise ValueError(f"camera_sizes must have different names, got {', '.join(names)}.")
    if len(rows) == 1:
        raise ValueError(
            f"camera_sizes are for several cameras, got only {names[0]!r}: use height and width."
        )
    return tuple(
        (name, *(check_positive_int(f"camera_sizes[{name!r}]", size) for size in row))
        for name, *row in rows
    )


def order_by_camera(
    rows: Iterable[Any], cameras: tuple[Any, ...]
) -> tuple[tuple[str, int, int], ...]:
    """Return rows of ``camera_sizes`` in the order of the cameras, whose names they must have."""
    names = [camera for camera in cameras if isinstance(camera, str)]
    by_name = {row[0]: row for row in rows}
    unnamed = iter(row for name, row in by_name.items() if name not in names)
    if len(by_name) != len(cameras) or not set(names) <= set(by_name):
        shown = [camera if isinstance(camera, str) else "(any name)" for camera in cameras]
        raise ValueError(
            f"camera_sizes must have the names of the cameras, {', '.join(shown)}; got "
            f"{', '.join(by_name)}."
        )
    return tuple(by_name[c] if isinstance(c, str) else next(unnamed) for c in cameras)


def _items(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, Iterable) and not isinstance(value, str) else (value,)


def check_obs_mode(value: object) -> str:
    """Return an ``obs_mode`` with its parts ordered like ``PARTS``; "both" for pixels and state."""
    parts = value.split("+") if isinstance(value, str) else []
    if len(parts) < 2 and "," not in str(value):
        check_choice("obs_mode", value, ("both", *PARTS))
    elif set(parts) <= set(PARTS) and len(set(parts)) == len(parts):
        value = "+".join(sorted(parts, key=PARTS.index))
    else:
        raise ValueError(
            f"obs_mode={value!r} must join different ones of {', '.join(PARTS)} by '+', such as "
            "'pixels+depth'."
        )
    return "both" if value == "pixels+state" else str(value)


def parts_of(obs_mode: str) -> tuple[str, ...]:
    """Return the parts of a checked ``obs_mode``."""
    return ("pixels", "state") if obs_mode == "both" else tuple(obs_mode.split("+"))
