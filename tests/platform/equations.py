"""The equations of a program, those of programs within it too."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from jax.extend import core


def equations(jaxpr: Any) -> Iterator[Any]:
    """Yield every equation that has no program of its own."""
    for eqn in jaxpr.eqns:
        inner = list(core.jaxprs_in_params(eqn.params))
        yield from [eqn] * (not inner)
        for sub in inner:
            yield from equations(sub)
