"""Two poles in a row with an actuated elbow."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, tolerance


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    return Start(jax.random.uniform(key, (dynamics.model.nq,), minval=-jnp.pi, maxval=jnp.pi))


def _observe(seen: Snapshot) -> jax.Array:
    """Return x and z parts of both arms' axes, then velocities."""
    axes = jnp.stack([seen.xmat("upper_arm")[:, 2], seen.xmat("lower_arm")[:, 2]])
    return joined(axes[:, 0], axes[:, 2], seen.qvel)


def _reward(seen: Snapshot, *, margin: float) -> jax.Array:
    distance = jnp.linalg.norm(seen.site_pos("target") - seen.site_pos("tip"))
    radius = float(seen.model.site("target").size[0])
    return tolerance(distance, (0.0, radius), margin=margin)


def _task(margin: float) -> Formulas:
    return Formulas(_start, _observe, partial(_reward, margin=margin))


TASKS = {"swingup": _task(1.0), "swingup_sparse": _task(0.0)}
