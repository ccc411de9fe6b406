"""A cart on a rail with a pole."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance


def _start_hanging(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample a cart near the middle with its pole down."""
    noise = 0.01 * jax.random.normal(key, (2, dynamics.model.nq))
    return Start(jnp.array([0.0, jnp.pi]) + noise[0], noise[1])


def _start_upright(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample a cart near the middle with its pole almost upright."""
    pose, speed = jax.random.split(key)
    reach = jnp.array([0.1, 0.034])
    qpos = jax.random.uniform(pose, (2,), minval=-reach, maxval=reach)
    return Start(qpos, 0.01 * jax.random.normal(speed, (dynamics.model.nv,)))


def _observe(seen: Snapshot) -> jax.Array:
    """Return the cart's position, cosine and sine of the pole's angle, and velocities."""
    pole = seen.xmat("pole_1")
    return joined(seen.joint_pos("slider"), pole[2, 2], pole[0, 2], seen.qvel)


def _reward(seen: Snapshot) -> jax.Array:
    """Return a product: upright pole, cart in the middle, little force, slow pole."""
    upright = (seen.xmat("pole_1")[2, 2] + 1) / 2
    centered = (1 + tolerance(seen.joint_pos("slider")[0], margin=2.0)) / 2
    small_control = tolerance(seen.ctrl[0], margin=1.0, value_at_margin=0.0, sigmoid="quadratic")
    small_velocity = (1 + tolerance(seen.qvel[1], margin=5.0)) / 2
    return upright * (4 + small_control) / 5 * small_velocity * centered


def _reward_sparse(seen: Snapshot) -> jax.Array:
    """Return 1 with the pole upright and the cart in the middle, else 0."""
    centered = tolerance(seen.joint_pos("slider")[0], (-0.25, 0.25))
    return centered * tolerance(seen.xmat("pole_1")[2, 2], (0.995, 1.0))


TASKS = {
    "balance": Formulas(_start_upright, _observe, _reward),
    "balance_sparse": Formulas(_start_upright, _observe, _reward_sparse),
    "swingup": Formulas(_start_hanging, _observe, _reward),
    "swingup_sparse": Formulas(_start_hanging, _observe, _reward_sparse),
}
