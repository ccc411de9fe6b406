"""Options that may be objects in Python and are names on a command line."""

from __future__ import annotations

from typing import get_type_hints

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

from pixelbrax_jax.config import EnvConfig

names_for_objects = ConstructorRegistry()
"""As a context, lets ``tyro.cli`` read every field of ``EnvConfig``."""


@names_for_objects.primitive_rule
def _name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    types = get_type_hints(EnvConfig)
    if info.type not in [types[name] for name in ("camera", "look", "clips")]:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="FOLDER" if info.type == types["clips"] else "NAME",
        instance_from_str=lambda args: args[0],
        is_instance=lambda value: value is None or isinstance(value, str),
        str_from_instance=lambda value: [str(value)],
    )


@names_for_objects.primitive_rule
def _names(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    if info.type != get_type_hints(EnvConfig)["distractors"]:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME ...]",
        instance_from_str=tuple,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=list,
    )
