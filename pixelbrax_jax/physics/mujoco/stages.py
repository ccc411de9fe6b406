"""A step of MuJoCo XLA with three stages of our own.

They are the constraint solver (``solver``), the solution for inertia, and the frames of contacts
between planes and capsules. ``mjx.step`` has the others in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mujoco import elimination
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.solver import solve

with import_silenced():
    from mujoco import mjx
    from mujoco.mjx._src import derivative, scan, smooth, support
    from mujoco.mjx._src import forward as mjx_forward

_PLANE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_EULER, _RK4 = int(mujoco.mjtIntegrator.mjINT_EULER), int(mujoco.mjtIntegrator.mjINT_RK4)
_IMPLICITFAST = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


def is_supported(model: mujoco.MjModel) -> bool:
    """Return whether a model is supported: Newton's solver, pyramids or cones of one condim."""
    dimensions = {*model.geom_condim.tolist(), *model.pair_dim.tolist()}
    return bool(
        model.opt.integrator in (_EULER, _RK4, _IMPLICITFAST)
        and model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
        and (model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL or len(dimensions) == 1)
    )


def step(model: Any, data: Any) -> Any:
    """Advance by one time step, as ``mjx.step`` does."""
    if int(model.opt.integrator) == _EULER:
        return _euler(model, forward(model, data))
    if int(model.opt.integrator) == _IMPLICITFAST:
        return _implicit(model, forward(model, data))
    # Traced once, used four times.
    compute = jax.jit(lambda data: forward(model, data))
    return _runge_kutta(model, compute(data), compute)


def forward(model: Any, data: Any) -> Any:
    """Compute accelerations, as ``mjx.forward`` does."""
    for stage in (mjx.kinematics, mjx.com_pos, mjx.camlight, mjx.tendon, mjx.crb):
        data = stage(model, data)
    data = collide(model, smooth.tendon_armature(model, data))
    stages = mjx.make_constraint, mjx.transmission, mjx.sensor_pos, mjx.fwd_velocity
    for stage in (*stages, mjx.sensor_vel, mjx.fwd_actuation):
        data = stage(model, data)
    applied = data.qfrc_applied + support.xfrc_accumulate(model, data)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + applied
    acceleration = _solve_inertia(model, data, data._impl.M, force)
    data = data.replace(qfrc_smooth=force, qacc_smooth=acceleration)
    is_free = data._impl.efc_J.size == 0
    data = data.replace(qacc=acceleration) if is_free else solve(model, data)
    return mjx.sensor_acc(model, data)


def collide(model: Any, data: Any) -> Any:
    """Find contacts as MuJoCo XLA does, with MuJoCo's frames between planes and capsules.

    The friction cone is a pyramid, so the direction of its edges matters. MuJoCo points the first
    edge along the capsule, MuJoCo XLA along a world axis if the capsule is steeper than 60 degrees;
    this changes single control steps of the humanoid by up to 0.3 rad/s.
    """
    data = mjx.collision(model, data)
    contact = data._impl.contact
    kinds = jnp.asarray(model.geom_type)[contact.geom]
    is_ours = (kinds[:, 0] == _PLANE) & (kinds[:, 1] == _CAPSULE)
    normal, axis = jnp.moveaxis(data.geom_xmat[contact.geom][..., 2], 1, 0)
    along = axis - normal * jnp.sum(normal * axis, axis=-1, keepdims=True)
    length = jnp.linalg.norm(along, axis=-1, keepdims=True)
    along = along / jnp.maximum(length, 1e-6)
    ours = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    # An upright capsule has no direction.
    is_ours = is_ours[:, None, None] & (length[:, :, None] > 1e-6)
    frame = jnp.where(is_ours, ours, contact.frame)
    return data.tree_replace({"_impl.contact.frame": frame})


def _solve_inertia(model: Any, data: Any, inertia: jax.Array, force: jax.Array) -> jax.Array:
    if not support.is_sparse(model):
        return elimination.solve(inertia, force)
    data = smooth.factor_m(model, data.tree_replace({"_impl.M": inertia}))
    return smooth.solve_m(model, data, force)


def _euler(model: Any, data: Any) -> Any:
    """Advance as ``mjx.euler`` does: with damping that is implicit in the velocity."""
    acceleration = data.qacc
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        damping = model.opt.timestep * model.dof_damping + _after(acceleration)
        inertia = data._impl.M
        if support.is_sparse(model):
            diagonal = model.M_rowadr + model.M_rownnz - 1
            inertia = inertia.at[diagonal].add(damping)
        else:
            inertia += jnp.diag(damping)
        force = data.qfrc_smooth + data.qfrc_constraint
        acceleration = _solve_inertia(model, data, inertia, force)
    return mjx_forward._advance(model, data, data.act_dot, acceleration)


def _implicit(model: Any, data: Any) -> Any:
    """Advance as ``mjx.implicit`` does: with forces that are implicit in the velocity."""
    acceleration = data.qacc
    slope = derivative.deriv_smooth_vel(model, data)
    if slope is not None:
        inertia = support.full_m(model, data) if support.is_sparse(model) else data._impl.M
        inertia += _after(acceleration) - model.opt.timestep * slope
        force = data.qfrc_smooth + data.qfrc_constraint
        acceleration = elimination.solve(inertia, force)
    return mjx_forward._advance(model, data, data.act_dot, acceleration)


def _after(acceleration: jax.Array) -> jax.Array:
    """Return 0 computed from the solver's result, so that XLA waits for the solver.

    On a CPU jaxlib 0.10.0 to 0.11.0 distribute a batch of factorisations among XLA's threads, and
    hang if as many batches as threads run at once: one waits for the other. XLA does not know that
    the sum is 0, because it might be NaN.
    """
    return (0 * acceleration).sum()


def _runge_kutta(model: Any, data: Any, compute: Callable[[Any], Any]) -> Any:
    """Advance as ``mjx.rungekutta4`` does: ``compute`` is ``forward``, done for ``data``."""
    timestep = model.opt.timestep
    first, velocity = data, data.qvel
    weights, fractions = (1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.5, 0.5, 1.0)

    def position(velocity: jax.Array) -> jax.Array:
        def integrate(kinds: Any, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
            return mjx_forward._integrate_pos(kinds, qpos, qvel, dt=timestep)

        return scan.flat(model, integrate, "jqv", "q", model.jnt_type, first.qpos, velocity)

    def weighted(weight: float, velocity: jax.Array, data: Any) -> tuple[jax.Array, ...]:
        return weight * velocity, weight * data.qacc, weight * data.act_dot

    total = weighted(weights[0], velocity, data)
    for fraction, weight in zip(fractions, weights[1:], strict=True):
        change, acceleration, act_dot = weighted(fraction, velocity, data)
        velocity = first.qvel + acceleration * timestep
        data = compute(
            data.replace(
                qpos=position(change),
                qvel=velocity,
                act=first.act + act_dot * timestep,
                time=first.time + fraction * timestep,
            )
        )
        added = weighted(weight, velocity, data)
        total = tuple(a + b for a, b in zip(total, added, strict=True))
    mean_velocity, acceleration, act_dot = total
    data = data.replace(qpos=first.qpos, qvel=first.qvel, act=first.act, time=first.time)
    # As in MuJoCo, whose later stages have no sensors.
    data = data.replace(sensordata=first.sensordata)
    return mjx_forward._advance(model, data, act_dot, acceleration, mean_velocity)
