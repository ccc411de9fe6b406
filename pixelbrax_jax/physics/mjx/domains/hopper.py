"""A planar one-legged body that hops."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined, rising, tolerance
from pixelbrax_jax.physics.mjx.resets import random_joints

_STAND_HEIGHT = 0.6
_HOP_SPEED = 2.0


def _start(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions and the root's angle, without a check for contacts."""
    return Start(random_joints(dynamics.model, key))


def _observe(seen: Snapshot) -> jax.Array:
    """Return joint positions without x, velocities and touch of the foot."""
    touch = jnp.log1p(seen.sensor("touch_toe", "touch_heel"))
    return joined(seen.qpos[1:], seen.qvel, touch)


def _standing(seen: Snapshot) -> jax.Array:
    """Return 1 with the torso high enough above the foot, else 0."""
    height = (seen.xipos("torso") - seen.xipos("foot"))[2]
    return tolerance(height, (_STAND_HEIGHT, 2.0))


def _reward_stand(seen: Snapshot) -> jax.Array:
    """Return 1 for standing, less for forces."""
    small = tolerance(seen.ctrl, margin=1.0, value_at_margin=0.0, sigmoid="quadratic")
    return _standing(seen) * (jnp.mean(small) + 4) / 5


def _reward_hop(seen: Snapshot) -> jax.Array:
    """Return 1 for standing at 2 m/s along x, less for slower."""
    speed = seen.sensor("torso_subtreelinvel")[0]
    return _standing(seen) * rising(speed, _HOP_SPEED, _HOP_SPEED / 2, value_at_margin=0.5)


def _task(reward: Callable[[Snapshot], jax.Array]) -> Formulas:
    return Formulas(
        _start, _observe, reward, substeps=4, reads_forces=True, starts_with_forces=True
    )


TASKS = {"stand": _task(_reward_stand), "hop": _task(_reward_hop)}
