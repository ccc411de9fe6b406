"""How physics is made, which is what a pickle keeps of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Recipe(NamedTuple):
    """A function and its arguments that give the physics, equal ones for equal recipes.

    Attributes:
        make: of a module, for a pickle names it.
        arguments: hashable.
    """

    make: Callable[..., Any]
    arguments: tuple[Any, ...]
