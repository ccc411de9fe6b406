"""DM Control's soft indicator function, of which its rewards are made."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp


def tolerance(
    x: jax.Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> jax.Array:
    """Return 1 within bounds, and less the farther outside.

    The formulas are those of section 4.3 of arXiv 1801.00690 and of
    ``dm_control.utils.rewards.tolerance``; of its sigmoids those that the suite's tasks use.

    Args:
        x: the quantity, of any shape.
        bounds: lower and upper bound, inclusive; may be infinite.
        margin: distance from the bounds at which the result is ``value_at_margin``; with 0 the
            result is 0 outside.
        sigmoid: how the result falls: ``gaussian``, ``long_tail``, ``linear`` or ``quadratic``.
        value_at_margin: the result at that distance; in [0, 1) for ``linear`` and ``quadratic``,
            in (0, 1) for the others, which reach 0 nowhere.

    Returns:
        Values in [0, 1], of the shape of ``x``.
    """
    lower, upper = bounds
    inside = (x >= lower) & (x <= upper)
    if margin == 0:
        return jnp.where(inside, 1.0, 0.0)
    # Nothing is above an infinite bound, and the distance to it would be infinite.
    distance = lower - x if upper == math.inf else jnp.where(x < lower, lower - x, x - upper)
    return jnp.where(inside, 1.0, _SIGMOIDS[sigmoid](distance / margin, value_at_margin))


def _gaussian(x: jax.Array, value_at_1: float) -> jax.Array:
    return jnp.exp(-0.5 * (x * math.sqrt(-2 * math.log(value_at_1))) ** 2)


def _long_tail(x: jax.Array, value_at_1: float) -> jax.Array:
    return 1 / ((x * math.sqrt(1 / value_at_1 - 1)) ** 2 + 1)


def _linear(x: jax.Array, value_at_1: float) -> jax.Array:
    scaled = x * (1 - value_at_1)
    return jnp.where(jnp.abs(scaled) < 1, 1 - scaled, 0.0)


def _quadratic(x: jax.Array, value_at_1: float) -> jax.Array:
    scaled = x * math.sqrt(1 - value_at_1)
    return jnp.where(jnp.abs(scaled) < 1, 1 - scaled**2, 0.0)


_SIGMOIDS = {
    "gaussian": _gaussian,
    "linear": _linear,
    "long_tail": _long_tail,
    "quadratic": _quadratic,
}
