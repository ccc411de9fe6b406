"""Building blocks of the DM Control Suite's tasks."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import Start
from pixelbrax_jax.physics.mujoco.opengl import mujoco

_MAX_ATTEMPTS = 1000
"""Largest number of sampled poses."""


def tolerance(
    x: jax.Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> jax.Array:
    """Return 1 within bounds (inclusive), and less with the distance outside.

    The formulas are those of section 4.3 of arXiv 1801.00690 and of
    ``dm_control.utils.rewards.tolerance``, with the sigmoids that the suite uses.

    Bounds may be infinite. At ``margin`` from them the result is ``value_at_margin``: in [0, 1),
    and not 0 for ``gaussian`` and ``long_tail``. With ``margin`` 0 it is 0 outside.
    """
    lower, upper = bounds
    inside = (x >= lower) & (x <= upper)
    if margin == 0:
        return jnp.where(inside, 1.0, 0.0)
    # The distance to an infinite bound would be infinite.
    distance = lower - x if upper == math.inf else jnp.where(x < lower, lower - x, x - upper)
    return jnp.where(inside, 1.0, _SIGMOIDS[sigmoid](distance / margin, value_at_margin))


def small_control(control: jax.Array) -> jax.Array:
    """Return 1 for controls of 0, and less the larger they are."""
    return tolerance(control, margin=1.0, value_at_margin=0.0, sigmoid="quadratic")


def rising(x: jax.Array, bound: float, margin: float, value_at_margin: float = 0.0) -> jax.Array:
    """Return 1 from a bound on, and linearly less below it; see ``tolerance``."""
    return tolerance(x, (bound, math.inf), margin, "linear", value_at_margin)


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


def random_joints(model: mujoco.MjModel, key: jax.Array) -> jax.Array:
    """Sample joint positions (Q,) as DM Control's ``randomize_limited_and_rotational_joints`` does.

    Limited hinges and slides are uniform in their range, other hinges in [-pi, pi]. A free joint
    keeps its position; its quaternion is sampled uniformly from [0, 1]^4 and normalised, which is
    not uniform over rotations but is what DM Control does. There are no ball joints.
    """
    low, high = np.array(model.qpos0), np.array(model.qpos0)
    rotations = []
    for kind, limited, reach, at in zip(
        model.jnt_type, model.jnt_limited, model.jnt_range, model.jnt_qposadr, strict=True
    ):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            low[at + 3 : at + 7], high[at + 3 : at + 7] = 0.0, 1.0
            rotations.append(int(at) + 3)
        elif limited:
            low[at], high[at] = reach
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            low[at], high[at] = -np.pi, np.pi
    qpos = low + (high - low) * jax.random.uniform(key, (model.nq,))
    qpos = qpos.astype(jnp.float32)
    for at in rotations:
        quat = qpos[at : at + 4]
        qpos = qpos.at[at : at + 4].set(quat / jnp.linalg.norm(quat))
    return qpos


def random_rotation(key: jax.Array) -> jax.Array:
    """Sample a (4,) float32 unit quaternion, uniformly over rotations."""
    quat = jax.random.normal(key, (4,))
    return quat / jnp.linalg.norm(quat)


def free_of_contact(
    dynamics: Dynamics, key: jax.Array, sample: Callable[[jax.Array, Start], Start]
) -> Start:
    """Sample initial states until no geoms touch, at most ``_MAX_ATTEMPTS`` times.

    ``sample`` maps a key and the previous sample, at first all zeros, to an initial state. The last
    one is returned even if geoms touch.
    """

    def again(carry: tuple[jax.Array, Start, jax.Array]) -> jax.Array:
        attempt, _, touches = carry
        return touches & (attempt < _MAX_ATTEMPTS)

    def attempt(
        carry: tuple[jax.Array, Start, jax.Array],
    ) -> tuple[jax.Array, Start, jax.Array]:
        number, before, _ = carry
        start = sample(jax.random.fold_in(key, number), before)
        return number + 1, start, jnp.any(dynamics.clearances(start.qpos) < 0)

    zeros = Start(jnp.zeros(dynamics.model.nq), jnp.zeros(dynamics.model.nv))
    shapes = jax.eval_shape(sample, key, zeros)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.while_loop(again, attempt, (jnp.int32(0), nothing, jnp.bool_(True)))[1]


def start_anywhere(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions as ``random_joints``, without a check for contacts."""
    return Start(random_joints(dynamics.model, key))


def start_free_of_contact(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions as ``random_joints`` until no geoms touch."""
    return free_of_contact(dynamics, key, lambda key, _: start_anywhere(dynamics, key))
