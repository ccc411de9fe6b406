"""Initial states, observations, rewards and ends of Gymnasium's MuJoCo tasks, version 5.

The formulas are those of ``gymnasium.envs.mujoco``. Velocities of bodies come from the change of
the joint positions, which the engine computes before it rounds to float32.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import (
    Formulas,
    Snapshot,
    Start,
    joined,
    observe_joints,
    observe_joints_from,
)
from pixelbrax_jax.spatial import f32

_REACHER_RADIUS = 0.2
_PUSHER_CLEARANCE = 0.17
_BODY_FIELDS = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")


def _near_default(
    dynamics: Dynamics, key: jax.Array, *, noise: float, normal: bool = False
) -> Start:
    """Add uniform noise to the model's pose; velocities are uniform too, or normal."""
    model = dynamics.model
    positions, velocities = jax.random.split(key)
    qpos = model.qpos0 + jax.random.uniform(positions, (model.nq,), minval=-noise, maxval=noise)
    if normal:
        qvel = noise * jax.random.normal(velocities, (model.nv,))
    else:
        qvel = jax.random.uniform(velocities, (model.nv,), minval=-noise, maxval=noise)
    return Start(qpos, qvel)


def _start_reacher(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample the arm near its default pose, and the target in a disk."""
    arm, radius, angle, velocities = jax.random.split(key, 4)
    qpos = dynamics.model.qpos0[:2] + jax.random.uniform(arm, (2,), minval=-0.1, maxval=0.1)
    # Gymnasium rejects points of a square, which has the same distribution.
    distance = _REACHER_RADIUS * jnp.sqrt(jax.random.uniform(radius))
    turn = jax.random.uniform(angle, minval=-jnp.pi, maxval=jnp.pi)
    goal = distance * jnp.stack([jnp.cos(turn), jnp.sin(turn)])
    qvel = jax.random.uniform(velocities, (2,), minval=-0.005, maxval=0.005)
    return Start(joined(qpos, goal), joined(qvel, jnp.zeros(2)))


def _start_pusher(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample the cylinder, not too near to the goal, and small velocities of the arm."""
    model = dynamics.model
    places, velocities = jax.random.split(key)

    def place(number: jax.Array) -> jax.Array:
        low, high = jnp.array([-0.3, -0.2]), jnp.array([0.0, 0.2])
        return jax.random.uniform(jax.random.fold_in(places, number), (2,), minval=low, maxval=high)

    def is_near(number: jax.Array) -> jax.Array:
        return jnp.linalg.norm(place(number)) <= _PUSHER_CLEARANCE

    number = jax.lax.while_loop(is_near, lambda number: number + 1, jnp.int32(0))
    arm = jnp.asarray(model.qpos0[:-4], jnp.float32)
    speed = jax.random.uniform(velocities, (model.nv - 4,), minval=-0.005, maxval=0.005)
    return Start(joined(arm, place(number), jnp.zeros(2)), joined(speed, jnp.zeros(4)))


def _left(seen: Snapshot, body: str) -> jax.Array:
    """Return (3,) metres, a body's position as MuJoCo's last step left it."""
    return seen.data.fields["xpos"][seen.model.body(body).id]


def _with_clipped_speed(seen: Snapshot) -> jax.Array:
    """Return joint positions without x, and velocities.

    * ``qpos[1:]``
    * ``qvel`` clipped to [-10, 10]
    """
    return joined(seen.state.qpos[1:], jnp.clip(seen.state.qvel, -10, 10))


def _observe_ant(seen: Snapshot) -> jax.Array:
    """Return joint positions without x and y, velocities, and forces.

    * ``qpos[2:]``
    * ``qvel``
    * ``6 * (model.nbody - 1)`` of each body: external torque and force, clipped to [-1, 1]
    """
    forces = jnp.clip(seen.data.fields["cfrc_ext"], -1, 1)
    return joined(observe_joints_from(seen, skipped=2), forces[1:])


def _observe_humanoid(seen: Snapshot) -> jax.Array:
    """Return joint positions without x and y, velocities, inertia and forces.

    * ``qpos[2:]``
    * ``qvel``
    * ``10 * (model.nbody - 1)`` of each body: inertia about the center of mass, and mass
    * ``6 * (model.nbody - 1)`` of each body: angular (rad/s) and linear velocity (m/s)
    * ``model.nv - 6`` of each hinge: torque of its actuator, N m
    * ``6 * (model.nbody - 1)`` of each body: external torque (N m) and force (N)
    """
    fields = seen.data.fields
    bodies = fields["cinert"][1:], fields["cvel"][1:]
    return joined(
        observe_joints_from(seen, skipped=2),
        *bodies,
        fields["qfrc_actuator"][6:],
        fields["cfrc_ext"][1:],
    )


def _observe_double_pendulum(seen: Snapshot) -> jax.Array:
    """Return the cart's position, the poles' angles, velocities, and a force.

    * ``qpos[:1]``
    * ``2`` sines of both hinges
    * ``2`` cosines of both hinges
    * ``qvel`` clipped to [-10, 10]
    * ``1`` constraint force on the cart (N), clipped to [-10, 10]
    """
    state, force = seen.state, seen.data.fields["qfrc_constraint"][:1]
    angles = state.qpos[1:]
    return joined(
        state.qpos[:1],
        jnp.sin(angles),
        jnp.cos(angles),
        jnp.clip(state.qvel, -10, 10),
        jnp.clip(force, -10, 10),
    )


def _observe_reacher(seen: Snapshot) -> jax.Array:
    """Return the arm's angles and velocities, the target, and the vector from it.

    * ``2`` cosines of both hinges
    * ``2`` sines of both hinges
    * ``qpos[2:]``
    * ``qvel[:2]``
    * ``2`` from the target to the fingertip: x and y, m
    """
    state = seen.state
    angles = state.qpos[:2]
    away = (_left(seen, "fingertip") - _left(seen, "target"))[:2]
    return joined(jnp.cos(angles), jnp.sin(angles), state.qpos[2:], state.qvel[:2], away)


def _observe_pusher(seen: Snapshot) -> jax.Array:
    """Return the arm's joints, and where its tip, the cylinder and the goal are.

    * ``qpos[:7]``
    * ``qvel[:7]``
    * ``9`` positions of the arm's tip, the cylinder and the goal, m
    """
    places = (_left(seen, name) for name in ("tips_arm", "object", "goal"))
    return joined(seen.state.qpos[:7], seen.state.qvel[:7], *places)


def _effort(seen: Snapshot, weight: float) -> jax.Array:
    return weight * jnp.sum(seen.state.ctrl**2)


def _within(x: jax.Array, low: float, high: float) -> jax.Array:
    return (low < x) & (x < high)


def _lagging_speed(seen: Snapshot, place: Callable[[Snapshot], jax.Array]) -> jax.Array:
    """Return the velocity along x of a place one physics step (of 5) behind the root's joint."""
    lag = place(seen) - seen.state.remembered
    return (seen.data.moved[0] + lag[0]) / (seen.model.opt.timestep * 5)


def _torso(seen: Snapshot) -> jax.Array:
    """Return (2,) metres, the first body relative to the root's joint."""
    return seen.data.fields["xpos"][1, :2] - seen.state.qpos[:2]


def _center_of_mass(seen: Snapshot) -> jax.Array:
    """Return (2,) metres, the center of mass relative to the root's joint."""
    masses = f32(seen.model.body_mass / seen.model.body_mass.sum())
    # The world has no mass. Differences from the root keep their digits far away.
    root = joined(seen.state.qpos[:2], 0.0)
    return jnp.dot(masses[1:], seen.data.fields["xipos"][1:] - root)[:2]


def _reward_runner(seen: Snapshot, *, substeps: int, effort: float) -> jax.Array:
    """Return ``v - {effort!g} * sum(u ** 2)``; v: velocity along x, m/s; u: the controls."""
    speed = seen.data.moved[0] / (seen.model.opt.timestep * substeps)
    return speed - _effort(seen, effort)


def _ant_fell(seen: Snapshot) -> jax.Array:
    """Return whether the torso's height is outside [0.2, 1] m."""
    z = seen.state.qpos[2]
    return ~((z >= 0.2) & (z <= 1.0))


def _reward_ant(seen: Snapshot) -> jax.Array:
    """Return ``v + 1 - 0.5 * sum(u ** 2) - 0.0005 * sum(c ** 2)``, without the 1 at the end.

    v: velocity of the torso along x, m/s; u: the controls; c: external torques and forces on the
    bodies, clipped to [-1, 1].
    """
    forces = jnp.clip(seen.data.fields["cfrc_ext"], -1, 1)
    forward = _lagging_speed(seen, _torso)
    healthy = jnp.where(_ant_fell(seen), 0.0, 1.0)
    return forward + healthy - _effort(seen, 0.5) - 5e-4 * jnp.sum(forces**2)


def _hopper_fell(seen: Snapshot) -> jax.Array:
    """Return whether the height is at most 0.7 m, or the angle beyond 0.2 rad.

    It also ends when another entry of the state reaches 100.
    """
    _, z, angle = seen.state.qpos[:3]
    rest = joined(seen.state.qpos, seen.state.qvel)[2:]
    return ~(jnp.all(_within(rest, -100, 100)) & (z > 0.7) & _within(angle, -0.2, 0.2))


def _walker_fell(seen: Snapshot) -> jax.Array:
    """Return whether the height leaves (0.8, 2) m, or the angle (-1, 1) rad."""
    _, z, angle = seen.state.qpos[:3]
    return ~(_within(z, 0.8, 2.0) & _within(angle, -1.0, 1.0))


def _humanoid_fell(seen: Snapshot) -> jax.Array:
    """Return whether the torso's height leaves (1, 2) m."""
    return ~_within(seen.state.qpos[2], 1.0, 2.0)


def _impact(seen: Snapshot) -> jax.Array:
    return jnp.minimum(5e-7 * jnp.sum(seen.data.fields["cfrc_ext"] ** 2), 10.0)


def _reward_humanoid(seen: Snapshot) -> jax.Array:
    """Return ``1.25 * v + 5 - 0.1 * sum(u ** 2) - min(5e-7 * sum(c ** 2), 10)``.

    v: velocity of the center of mass along x, m/s; u: the controls; c: external torques and forces
    on the bodies. The 5 is missing at the episode's end.
    """
    forward = 1.25 * _lagging_speed(seen, _center_of_mass)
    healthy = jnp.where(_humanoid_fell(seen), 0.0, 5.0)
    return forward + healthy - _effort(seen, 0.1) - _impact(seen)


def _reward_standup(seen: Snapshot) -> jax.Array:
    """Return the height over a physics step's duration, less costs.

    ``z / {model.opt.timestep!g} + 1 - 0.1 * sum(u ** 2) - min(5e-7 * sum(c ** 2), 10)``; z: height
    of the torso, m; u: the controls; c: external torques and forces on the bodies.
    """
    height = seen.state.qpos[2] / seen.model.opt.timestep
    return height - _effort(seen, 0.1) - _impact(seen) + 1


def _pole_fell(seen: Snapshot) -> jax.Array:
    """Return whether the pole's angle is beyond 0.2 rad."""
    return jnp.abs(seen.state.qpos[1]) > 0.2


def _reward_pendulum(seen: Snapshot) -> jax.Array:
    """Return 1, and 0 at the episode's end."""
    return jnp.where(_pole_fell(seen), 0.0, 1.0)


def _tip(seen: Snapshot) -> tuple[jax.Array, jax.Array]:
    x, _, z = seen.data.fields["site_xpos"][0]
    return x, z


def _poles_fell(seen: Snapshot) -> jax.Array:
    """Return whether the tip's height is at most 1 m."""
    return _tip(seen)[1] <= 1


def _reward_double_pendulum(seen: Snapshot) -> jax.Array:
    """Return 10, less costs of the tip's place and of velocities.

    ``10 - 0.01 * x ** 2 - (z - 2) ** 2 - 0.001 * w1 ** 2 - 0.005 * w2 ** 2``, without the 10 at its
    end; x, z: the tip, m; w1, w2: velocities of the hinges, rad/s.
    """
    x, z = _tip(seen)
    first, second = seen.state.qvel[1:3]
    alive = jnp.where(_poles_fell(seen), 0.0, 10.0)
    return alive - 0.01 * x**2 - (z - 2) ** 2 - 1e-3 * first**2 - 5e-3 * second**2


def _reward_reacher(seen: Snapshot) -> jax.Array:
    """Return ``-d - sum(u ** 2)``; d: metres to the target; u: the controls."""
    away = _left(seen, "fingertip") - _left(seen, "target")
    return -jnp.linalg.norm(away) - _effort(seen, 1.0)


def _reward_pusher(seen: Snapshot) -> jax.Array:
    """Return ``-0.5 * near - away - 0.1 * sum(u ** 2)``.

    near: metres from the cylinder to the arm's tip; away: metres from the cylinder to the goal;
    u: the controls.
    """
    near = jnp.linalg.norm(_left(seen, "object") - _left(seen, "tips_arm"))
    away = jnp.linalg.norm(_left(seen, "object") - _left(seen, "goal"))
    return -0.5 * near - away - _effort(seen, 0.1)


def _stander(fell: Callable[[Snapshot], jax.Array]) -> Formulas:
    """Make the task of a body that runs and ends when it falls."""

    def reward(seen: Snapshot) -> jax.Array:
        """Return ``v + 1 - 0.001 * sum(u ** 2)``, without the 1 at the episode's end.

        v: velocity along x, m/s; u: the controls.
        """
        run = _reward_runner(seen, substeps=4, effort=1e-3)
        return run + jnp.where(fell(seen), 0.0, 1.0)

    return Formulas(
        partial(_near_default, noise=5e-3),
        _with_clipped_speed,
        reward,
        fell,
        substeps=4,
    )


FORMULAS = {
    "gym_ant": Formulas(
        partial(_near_default, noise=0.1, normal=True),
        _observe_ant,
        _reward_ant,
        _ant_fell,
        _torso,
        substeps=5,
        reads=("xpos", "cfrc_ext"),
    ),
    "gym_halfcheetah": Formulas(
        partial(_near_default, noise=0.1, normal=True),
        partial(observe_joints_from, skipped=1),
        partial(_reward_runner, substeps=5, effort=0.1),
        substeps=5,
    ),
    "gym_hopper": _stander(_hopper_fell),
    "gym_humanoid": Formulas(
        partial(_near_default, noise=1e-2),
        _observe_humanoid,
        _reward_humanoid,
        _humanoid_fell,
        _center_of_mass,
        substeps=5,
        reads=("xipos", *_BODY_FIELDS),
    ),
    "gym_humanoidstandup": Formulas(
        partial(_near_default, noise=1e-2),
        _observe_humanoid,
        _reward_standup,
        substeps=5,
        reads=_BODY_FIELDS,
    ),
    "gym_inverted_double_pendulum": Formulas(
        partial(_near_default, noise=0.1, normal=True),
        _observe_double_pendulum,
        _reward_double_pendulum,
        _poles_fell,
        substeps=5,
        reads=("site_xpos", "qfrc_constraint"),
    ),
    "gym_inverted_pendulum": Formulas(
        partial(_near_default, noise=0.01),
        observe_joints,
        _reward_pendulum,
        _pole_fell,
        substeps=2,
    ),
    "gym_pusher": Formulas(
        _start_pusher, _observe_pusher, _reward_pusher, substeps=5, reads=("xpos",)
    ),
    "gym_reacher": Formulas(
        _start_reacher, _observe_reacher, _reward_reacher, substeps=2, reads=("xpos",)
    ),
    "gym_swimmer": Formulas(
        partial(_near_default, noise=0.1),
        partial(observe_joints_from, skipped=2),
        partial(_reward_runner, substeps=4, effort=1e-4),
        substeps=4,
    ),
    "gym_walker2d": _stander(_walker_fell),
}
"""Formulas by the name of the task."""
