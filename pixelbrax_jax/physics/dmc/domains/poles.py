"""Poles that swing up: acrobot, cartpole and pendulum."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.dmc.formulas import small_control, start_anywhere, tolerance
from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import Formulas, Snapshot, Start, joined

_COSINE_BOUND = math.cos(math.radians(8))


def _observe_acrobot(seen: Snapshot) -> jax.Array:
    """Return both arms' axes, and velocities.

    * ``2`` x of the axes of the upper and the lower arm in the world frame
    * ``2`` z of the same: 1 is upright
    * ``qvel``
    """
    axes = jnp.stack([seen.xmat("upper_arm")[:, 2], seen.xmat("lower_arm")[:, 2]])
    return joined(axes[:, 0], axes[:, 2], seen.state.qvel)


def _reward_acrobot(seen: Snapshot, *, margin: float) -> jax.Array:
    """Return ``tolerance(d, [0, {model.site("target").size[0]!g}], margin={margin!g})``.

    d: metres from the tip to the target.
    """
    distance = jnp.linalg.norm(seen.site_pos("target") - seen.site_pos("tip"))
    radius = float(seen.model.site("target").size[0])
    return tolerance(distance, (0.0, radius), margin=margin)


def _start_hanging(dynamics: Dynamics, key: jax.Array) -> Start:
    noise = 0.01 * jax.random.normal(key, (2, dynamics.model.nq))
    return Start(jnp.array([0.0, jnp.pi]) + noise[0], noise[1])


def _start_upright(dynamics: Dynamics, key: jax.Array) -> Start:
    pose, speed = jax.random.split(key)
    reach = jnp.array([0.1, 0.034])
    qpos = jax.random.uniform(pose, (2,), minval=-reach, maxval=reach)
    return Start(qpos, 0.01 * jax.random.normal(speed, (dynamics.model.nv,)))


def _observe_cartpole(seen: Snapshot) -> jax.Array:
    """Return the cart's position, the pole's direction, and velocities.

    * ``joint_pos("slider")``
    * ``2`` cosine and sine of the pole's angle from upright
    * ``qvel``
    """
    pole = seen.xmat("pole_1")
    return joined(seen.joint_pos("slider"), pole[2, 2], pole[0, 2], seen.state.qvel)


def _reward_cartpole(seen: Snapshot) -> jax.Array:
    """Return the product of four numbers in [0, 1].

    ``(1 + cos) / 2``, cos: cosine of the pole's angle from upright; ``(1 + tolerance(x, [0, 0],
    margin=2)) / 2``, x: the cart's position, m; ``(4 + small(u)) / 5``, u: the control;
    ``(1 + tolerance(w, [0, 0], margin=5)) / 2``, w: the pole's speed, rad/s.
    """
    upright = (seen.xmat("pole_1")[2, 2] + 1) / 2
    centered = (1 + tolerance(seen.joint_pos("slider")[0], margin=2.0)) / 2
    small = small_control(seen.state.ctrl[0])
    small_velocity = (1 + tolerance(seen.state.qvel[1], margin=5.0)) / 2
    return upright * (4 + small) / 5 * small_velocity * centered


def _reward_cartpole_sparse(seen: Snapshot) -> jax.Array:
    """Return 1 while the cart is within 0.25 m of the middle and the pole nearly upright, else 0.

    Nearly upright: the cosine of the pole's angle is 0.995 or more.
    """
    centered = tolerance(seen.joint_pos("slider")[0], (-0.25, 0.25))
    return centered * tolerance(seen.xmat("pole_1")[2, 2], (0.995, 1.0))


def _observe_pendulum(seen: Snapshot) -> jax.Array:
    """Return the pole's direction, and velocities.

    * ``2`` cosine and sine of the angle from upright
    * ``qvel``
    """
    pole = seen.xmat("pole")
    return joined(pole[2, 2], pole[0, 2], seen.state.qvel)


def _reward_pendulum(seen: Snapshot) -> jax.Array:
    """Return 1 while the pole is within 8 degrees of upright, else 0."""
    return tolerance(seen.xmat("pole")[2, 2], (_COSINE_BOUND, 1.0))


_xla = partial(Formulas, prefers_xla=True)


def _acrobot(margin: float) -> Formulas:
    return _xla(start_anywhere, _observe_acrobot, partial(_reward_acrobot, margin=margin))


TASKS = {
    "dmc_acrobot_swingup": _acrobot(1.0),
    "dmc_acrobot_swingup_sparse": _acrobot(0.0),
    "dmc_cartpole_balance": _xla(_start_upright, _observe_cartpole, _reward_cartpole),
    "dmc_cartpole_balance_sparse": _xla(_start_upright, _observe_cartpole, _reward_cartpole_sparse),
    "dmc_cartpole_swingup": _xla(_start_hanging, _observe_cartpole, _reward_cartpole),
    "dmc_cartpole_swingup_sparse": _xla(_start_hanging, _observe_cartpole, _reward_cartpole_sparse),
    "dmc_pendulum_swingup": _xla(start_anywhere, _observe_pendulum, _reward_pendulum),
}
