"""Where the environments are in the arrays of a training state, declared beside each field.

Several devices share the environments: what belongs to environments is spread along them, and
everything else is the same on every device.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import jax
from flax import struct

_KEY = "env_axis"
_NONE = "none"


def along_envs(axis: int) -> Any:
    """Declare a field whose arrays have the environments along ``axis``."""
    return struct.field(metadata={_KEY: axis})


def without_envs() -> Any:
    """Declare a field that belongs to no environment."""
    return struct.field(metadata={_KEY: _NONE})


def as_declared(leading_axes: int = 0) -> Any:
    """Declare a field whose own class says where its environments are.

    Args:
        leading_axes: axes that its arrays have before those that the class speaks of.
    """
    return struct.field(metadata={_KEY: ("class", leading_axes)})


def env_axes(tree: Any) -> Any:
    """Return where the environments are in each leaf of a dataclass.

    Args:
        tree: a dataclass whose fields are declared by the functions above, or its
            ``jax.eval_shape``. A field may be None.

    Returns:
        The same tree; in place of a leaf its axis of environments, or -1 if it has none.

    Raises:
        TypeError: a field is not declared, or is none of the class that shall declare it.
    """
    found = {}
    for field in fields(tree):
        value, declared = getattr(tree, field.name), field.metadata.get(_KEY)
        if declared is None:
            raise TypeError(
                f"{type(tree).__name__}.{field.name} does not say where its environments are: "
                "declare it with along_envs, without_envs or as_declared."
            )
        if isinstance(declared, tuple) and value is not None:
            if not is_dataclass(value):
                raise TypeError(
                    f"{type(tree).__name__}.{field.name} must be a dataclass that declares its "
                    f"fields, got a {type(value).__name__}."
                )
            leading_axes = declared[1]
            found[field.name] = jax.tree.map(
                lambda axis, more=leading_axes: axis + more if axis >= 0 else axis, env_axes(value)
            )
        else:
            axis = declared if isinstance(declared, int) else -1
            found[field.name] = jax.tree.map(lambda _, axis=axis: axis, value)
    return tree.replace(**found)
