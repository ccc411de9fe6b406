"""A finger of two joints that turns a body on a hinge."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.formulas import Formulas, Snapshot, Start, joined
from pixelbrax_jax.physics.mjx.resets import free_of_contact, random_joints
from pixelbrax_jax.physics.opengl import mujoco

_SPIN_VELOCITY = 15.0

_OUT_OF_REACH = ("ground", "proximal_decoration", "proximal", "spinner_decoration")
"""The finger is 37.1 cm long, and its hinge is 40 cm from the ground and from the spinner's: only
the fingertip and the spinner's caps can touch."""


def _start_spin(dynamics: Dynamics, key: jax.Array) -> Start:
    return free_of_contact(dynamics, key, lambda key, _: Start(random_joints(dynamics.model, key)))


def _start_turn(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions, and a target on the circle that the body's tip can reach."""
    model = dynamics.model
    angle_key, pose_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, (), minval=-jnp.pi, maxval=jnp.pi)
    radius = float(model.geom("cap1").size.sum())
    direction = jnp.stack([jnp.sin(angle), 0.0, jnp.cos(angle)])
    place = jnp.asarray(model.body("spinner").pos, jnp.float32) + radius * direction
    return _start_spin(dynamics, pose_key).replace(target=place)


def _in_plane(seen: Snapshot, place: jax.Array) -> jax.Array:
    """Return (2,) metres, x and z of a position relative to the hinge."""
    return (place - seen.sensor("spinner"))[jnp.array([0, 2])]


def _observe_spin(seen: Snapshot) -> jax.Array:
    """Return joint positions, position of the tip, velocities and touch."""
    return joined(
        seen.sensor("proximal", "distal"),
        _in_plane(seen, seen.sensor("tip")),
        seen.sensor("proximal_velocity", "distal_velocity", "hinge_velocity"),
        jnp.log1p(seen.sensor("touchtop", "touchbottom")),
    )


def _distance(seen: Snapshot) -> jax.Array:
    """Return metres from the tip to the target's surface, negative inside."""
    offset = _in_plane(seen, seen.target) - _in_plane(seen, seen.sensor("tip"))
    return jnp.linalg.norm(offset) - float(seen.model.site("target").size[0])


def _observe_turn(seen: Snapshot) -> jax.Array:
    """Return the observation of spinning, position of the target and distance to it."""
    return joined(_observe_spin(seen), _in_plane(seen, seen.target), _distance(seen))


def _reward_spin(seen: Snapshot) -> jax.Array:
    """Return 1 from 15 rad/s on, else 0."""
    return jnp.where(seen.sensor("hinge_velocity")[0] <= -_SPIN_VELOCITY, 1.0, 0.0)


def _reward_turn(seen: Snapshot) -> jax.Array:
    """Return 1 with the tip in the target, else 0."""
    return jnp.where(_distance(seen) <= 0, 1.0, 0.0)


def _edit_spin(model: mujoco.MjModel) -> None:
    for site in ("target", "tip"):
        model.site(site).rgba[3] = 0.0
    model.dof_damping[model.joint("hinge").dofadr] = 0.03


def _resize_target(model: mujoco.MjModel, *, radius: float) -> None:
    model.site("target").size[0] = radius


_task = partial(Formulas, substeps=2, out_of_reach=_OUT_OF_REACH, reads_forces=True)


def _turn(radius: float) -> Formulas:
    edit = partial(_resize_target, radius=radius)
    return _task(_start_turn, _observe_turn, _reward_turn, edit=edit, movable=("target",))


TASKS = {
    "spin": _task(_start_spin, _observe_spin, _reward_spin, edit=_edit_spin),
    "turn_easy": _turn(0.07),
    "turn_hard": _turn(0.03),
}
