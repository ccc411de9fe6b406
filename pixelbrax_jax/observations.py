"""Parts of an observation: images of cameras, and the task's state."""

from __future__ import annotations

from typing import NamedTuple

from pixelbrax_jax.validation import check_choice


class Image(NamedTuple):
    """An image: channels per camera, dtype, and dtype as drawn, all channels in one number."""

    channels: int
    dtype: str
    drawn: str


IMAGES = {
    "pixels": Image(3, "uint8", "uint32"),
    "depth": Image(1, "float32", "float32"),
    "segmentation": Image(1, "int32", "int32"),
}
"""Images by name, in the order of an observation's entries."""

PARTS = (*IMAGES, "state")
"""Names that ``obs_mode`` may join."""

MAX_DEPTH = 100.0
"""Largest depth of an observation in metres, also that of the sky."""


def check_obs_mode(value: object) -> str:
    """Return an ``obs_mode`` with its parts ordered like ``PARTS``; "both" for pixels and state."""
    parts = value.split("+") if isinstance(value, str) else []
    if len(parts) < 2:
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
