"""A cup that catches a ball on a string."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined
from pixelbrax_jax.physics.mjx.resets import free_of_contact


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample a contact-free position of the ball; the cup is at rest in the middle."""
    model = dynamics.model
    x, z = (int(model.joint(name).qposadr[0]) for name in ("ball_x", "ball_z"))

    def sample(key: jax.Array, before: Start) -> Start:
        del before
        place = jax.random.uniform(
            key, (2,), minval=jnp.array([-0.2, 0.2]), maxval=jnp.array([0.2, 0.5])
        )
        return Start(jnp.asarray(model.qpos0, jnp.float32).at[jnp.array([x, z])].set(place))

    return free_of_contact(dynamics, key, sample)


def _observe(seen: Snapshot) -> jax.Array:
    return joined(seen.qpos, seen.qvel)


def _reward(seen: Snapshot) -> jax.Array:
    """Return 1 if all of the ball is inside the target, else 0."""
    offset = jnp.abs(seen.site_pos("target") - seen.xpos("ball"))
    size = seen.model.site("target").size - seen.model.geom("ball").size[0]
    return jnp.where((offset[0] < size[0]) & (offset[2] < size[2]), 1.0, 0.0)


TASKS = {"catch": Formulas(_start, _observe, _reward, substeps=10)}
