"""MuJoCo XLA's steps on a minimal state."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from pixelbrax_jax.physics.mjx.substitutes import substituted
from pixelbrax_jax.physics.mujoco_compatibility import import_silenced, load_onto_own_device
from pixelbrax_jax.physics.opengl import mujoco

with import_silenced():
    from mujoco import mjx
    from mujoco.mjx._src import io as mjx_io


class MjxState(struct.PyTreeNode):
    """The integration state: all that the next step depends on.

    Attributes:
        qpos: (Q,) float32, joint positions: metres, radians, unit quaternions.
        qvel: (V,) float32, joint velocities, per second.
        act: activations of actuators with a state.
        qacc_warmstart: (V,) float32, accelerations from which the solver starts.
        ctrl: (A,) float32, the last controls, for rewards.
        target: metres, this episode's target: (3,) float32; (7,) with a unit quaternion if it is a
            body; (0,) for tasks without one.
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    ctrl: jax.Array
    target: jax.Array


class Dynamics:
    """A model's dynamics, for one environment."""

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        reads_forces: bool = False,
        out_of_reach: Iterable[str] = (),
        target_body: str = "",
    ):
        """Put a compiled model on the device; compile nothing. For the rest see ``Formulas``."""
        load_onto_own_device(mjx_io)
        self.model = model
        self.reads_forces = reads_forces
        self._target_body = model.body(target_body).id if target_body else None
        self._simulated = _simulated(model, out_of_reach)
        self._mx = mjx.put_model(self._simulated, impl="jax")
        self._moving = (
            self._mx if reads_forces else self._without(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        )
        self._passive = self._without(mujoco.mjtDisableBit.mjDSBL_ACTUATION)

    def _without(self, feature: mujoco.mjtDisableBit) -> Any:
        flags = type(self._mx.opt.disableflags)(int(self._mx.opt.disableflags) | int(feature))
        return self._mx.replace(opt=self._mx.opt.replace(disableflags=flags))

    def state(
        self,
        qpos: jax.Array,
        qvel: jax.Array | None = None,
        target: jax.Array | None = None,
    ) -> MjxState:
        """Return a state without control or activation; without velocities it is at rest."""
        model = self.model
        return MjxState(
            qpos=jnp.asarray(qpos, jnp.float32),
            qvel=jnp.zeros(model.nv) if qvel is None else jnp.asarray(qvel, jnp.float32),
            act=jnp.zeros(model.na),
            qacc_warmstart=jnp.zeros(model.nv),
            ctrl=jnp.zeros(model.nu),
            target=jnp.zeros(0) if target is None else jnp.asarray(target, jnp.float32),
        )

    def step(self, state: MjxState, num_steps: int) -> tuple[MjxState, jax.Array]:
        """Advance by physics steps; return the state, and all sensors before the last step."""

        def one(state: MjxState) -> tuple[MjxState, jax.Array]:
            with substituted(self.model):
                data = mjx.step(self._moving, self._data(state))
            moved = state.replace(
                qpos=data.qpos, qvel=data.qvel, act=data.act, qacc_warmstart=data.qacc_warmstart
            )
            return moved, data.sensordata

        if num_steps == 1:
            return one(state)
        sensors = jnp.zeros(self.model.nsensordata)
        # A loop, so that the program has one copy of the step.
        return jax.lax.fori_loop(0, num_steps, lambda _, carry: one(carry[0]), (state, sensors))

    def at_rest(self, state: MjxState) -> tuple[MjxState, jax.Array]:
        """Return a first state with accelerations for the solver's start, and all sensors.

        Actuators are off, as in DM Control's resets.
        """
        with substituted(self.model):
            data = mjx.forward(self._passive, self._data(state))
        return state.replace(qacc_warmstart=data.qacc), data.sensordata

    def refresh(self, state: MjxState, sensors: jax.Array) -> Any:
        """Compute positions, velocities and their sensors, as ``mj_step1`` does.

        The readings of force and acceleration sensors are taken from ``sensors``. The returned
        ``mujoco.mjx.Data`` has no valid forces and accelerations.
        """
        mx = self._mx
        if self._target_body is not None:
            at = self._target_body
            mx = mx.replace(
                body_pos=mx.body_pos.at[at].set(state.target[:3]),
                body_quat=mx.body_quat.at[at].set(state.target[3:]),
            )
        data = self._data(state).replace(sensordata=sensors)
        with substituted(self.model):
            data = mjx.kinematics(mx, data)
            data = mjx.com_pos(mx, data)
            data = mjx.com_vel(mx, data)
            if self.model.nsensor:
                data = mjx.sensor_pos(mx, data)
                data = mjx.sensor_vel(mx, data)
        return data

    def touches(self, qpos: jax.Array) -> jax.Array:
        """Return () bool, whether any geoms touch at joint positions (Q,)."""
        contact = self._contact(qpos)
        return jnp.any(contact.dist < contact.includemargin)

    def site(self, qpos: jax.Array, name: str) -> tuple[jax.Array, jax.Array]:
        """Return (3,) metres and (3, 3), position and axes of a site at joint positions (Q,)."""
        with substituted(self.model):
            data = mjx.kinematics(self._mx, self._data(self.state(qpos)))
        row = self.model.site(name).id
        return data.site_xpos[row], data.site_xmat[row]

    def clearance(self, qpos: jax.Array, geom: str) -> jax.Array:
        """Return () metres between a geom and the nearest other one, negative if they overlap."""
        contact = self._contact(qpos)
        is_of_it = jnp.any(contact.geom == self.model.geom(geom).id, axis=-1)
        return jnp.min(jnp.where(is_of_it, contact.dist, jnp.inf))

    def _contact(self, qpos: jax.Array) -> Any:
        with substituted(self.model):
            data = mjx.kinematics(self._mx, self._data(self.state(qpos)))
            return mjx.collision(self._mx, data)._impl.contact

    def _data(self, state: MjxState) -> Any:
        return mjx.make_data(self._simulated, impl="jax").replace(
            qpos=state.qpos,
            qvel=state.qvel,
            act=state.act,
            qacc_warmstart=state.qacc_warmstart,
            ctrl=state.ctrl,
        )


def _simulated(model: mujoco.MjModel, out_of_reach: Iterable[str]) -> mujoco.MjModel:
    """Return the model without energy (unsupported), disabled contacts and geoms out of reach."""
    model = copy.copy(model)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if model.opt.disableflags & off:
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
    for name in out_of_reach:
        model.geom(name).contype[:] = model.geom(name).conaffinity[:] = 0
    return model
