"""Conversion of options to and from JSON types."""

from __future__ import annotations

import dataclasses
import enum
import os
from collections.abc import Mapping
from contextlib import suppress
from pkgutil import resolve_name
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.distractors.base import Distractor
from pixelbrax_jax.distractors.camera import MovingCamera
from pixelbrax_jax.distractors.color import Color
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.types import Camera, CameraRig, Lamp, Look
from pixelbrax_jax.validation import check_choice, check_options

TYPE = "type"
"""Key of a dictionary's type."""

_TYPES: dict[str, type] = {cls.__name__: cls for cls in (Camera, CameraRig, Lamp, Look)} | {
    cls.kind: cls for cls in (MovingCamera, Color, Video)
}
_NAMES = {cls: name for name, cls in _TYPES.items()}


def to_plain(value: Any) -> Any:
    """Convert an option's value to JSON types; a bank of clips or a local class is a ValueError.

    A camera, look or distractor becomes a dictionary with its fields and its ``"type"``: a name, or
    ``"module:Class"`` for a class of your own. Every option also takes such a dictionary.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, enum.Enum):
        return to_plain(value.value)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {name: to_plain(part) for name, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(part) for part in value]
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        return np.asarray(value).tolist()
    cls = type(value)
    if cls in _NAMES or (isinstance(value, Distractor) and dataclasses.is_dataclass(value)):
        name = _NAMES.get(cls) or _name_in_module(cls)
        fields = [field.name for field in dataclasses.fields(value) if field.init]
        parts = {name: getattr(value, name) for name in fields}
        return {TYPE: name} | {name: to_plain(part) for name, part in parts.items()}
    raise ValueError(f"JSON cannot represent a {cls.__name__}.")


def from_plain(value: Any) -> Any:
    """Convert a dictionary of ``to_plain``, or each one of a list, to its object; keep the rest."""
    if isinstance(value, (tuple, list)):
        return tuple(map(from_plain, value))
    if not isinstance(value, Mapping):
        return value
    if TYPE not in value:
        raise ValueError(
            f"a dictionary as an option needs an entry {TYPE!r}, one of {', '.join(_TYPES)}; got "
            f"{dict(value)!r}."
        )
    cls = _type_of(value[TYPE])
    parts = {name: part for name, part in value.items() if name != TYPE}
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    check_options(parts, fields)
    missing = [
        name
        for name, field in fields.items()
        if name not in parts and field.default is field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ValueError(f"a dictionary for {value[TYPE]} lacks {', '.join(missing)}.")
    return cls(**{name: _field(part, fields[name]) for name, part in parts.items()})


def _name_in_module(cls: type) -> str:
    name = f"{cls.__module__}:{cls.__qualname__}"
    # Another process cannot import `__main__` or a local class.
    if cls.__module__ == "__main__" or "<locals>" in name:
        raise ValueError(f"JSON cannot represent {name}: only a class of a module can be imported.")
    return name


def _type_of(name: Any) -> Any:
    if not isinstance(name, str) or ":" not in name:
        return _TYPES[check_choice(f"entry {TYPE!r}", name, _TYPES)]
    cls = None
    try:
        with suppress(AttributeError):
            cls = resolve_name(name)
    except ModuleNotFoundError as error:
        raise ValueError(f"{TYPE}={name!r}: {error}.") from error
    if not (isinstance(cls, type) and issubclass(cls, Distractor)):
        raise ValueError(
            f"{TYPE}={name!r} must be a subclass of pixelbrax_jax.distractors.Distractor."
        )
    return cls


def _field(value: Any, field: dataclasses.Field[Any]) -> Any:
    is_array = "jax.Array" in str(field.type) and value is not None
    return np.asarray(value, np.float32) if is_array else from_plain(value)
