"""MuJoCo XLA: steps of a model for one environment, for accelerators and gradients."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mujoco import stages
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced, load_onto_own_device
from pixelbrax_jax.physics.mujoco.multipliers import multiplied
from pixelbrax_jax.physics.mujoco.needs import Needs
from pixelbrax_jax.physics.mujoco.omissions import check_simulated
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.sensors import read_more_than_bodies

with import_silenced():
    from mujoco import mjx
    from mujoco.mjx._src import io as mjx_io
    from mujoco.mjx._src import smooth

Arrays = tuple[jax.Array, ...]


class Xla:
    """Steps of a model, as ``Native`` makes them, for one environment and as pure functions."""

    has_own_stages: ClassVar[bool] = True
    """Whether our stages replace MuJoCo XLA's where they support the model."""

    def __init__(self, model: mujoco.MjModel, needs: Needs):
        load_onto_own_device(mjx_io)
        check_simulated(model)
        self._model = model
        self._reads_forces = needs.reads_forces or bool(needs.reads)
        self._starts_with_forces = needs.starts_with_forces or bool(needs.reads)
        self._fields = needs.reads
        # What a step leaves, by its names of `MjData`.
        self._left = ("qpos", "qvel", "act", "qacc_warmstart", "sensordata", *needs.reads)
        self._stages: Any = stages if self.has_own_stages and stages.is_supported(model) else mjx
        self.simulated = _simulated(model, needs.out_of_reach)
        try:
            self._mx = mjx.put_model(self.simulated, impl="jax")
        except NotImplementedError as error:
            raise ValueError(
                f"MuJoCo XLA cannot simulate this model: {error}. Compute on a CPU, with "
                "engine='mujoco'."
            ) from error
        unread = self._without(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._moving = self._mx if needs.reads_forces else unread
        self._passive = self._without(mujoco.mjtDisableBit.mjDSBL_ACTUATION)

    def _without(self, feature: mujoco.mjtDisableBit) -> Any:
        flags = type(self._mx.opt.disableflags)(int(self._mx.opt.disableflags) | int(feature))
        return self._mx.replace(opt=self._mx.opt.replace(disableflags=flags))

    def step(
        self,
        num_steps: int,
        qpos: jax.Array,
        qvel: jax.Array,
        act: jax.Array,
        qacc_warmstart: jax.Array,
        ctrl: jax.Array,
        multipliers: jax.Array,
    ) -> Arrays:
        """See ``Native.step``."""
        first, model = qpos, changed(self._moving, multipliers)
        move = self._mover(model, multipliers)

        def one(carry: Arrays) -> Arrays:
            qpos, qvel, act, warmstart, *_ = carry
            data = move(self._data(qpos, qvel, act=act, qacc_warmstart=warmstart, ctrl=ctrl))
            if "cfrc_ext" in self._fields:
                data = smooth.rne_postconstraint(model, data)
            return tuple(getattr(data, name) for name in self._left)

        carry: Arrays = (qpos, qvel, act, qacc_warmstart)
        blank = self._data(qpos, qvel)
        carry += tuple(jnp.zeros_like(getattr(blank, name)) for name in self._left[len(carry) :])
        if num_steps == 1:
            carry = one(carry)
        else:
            # A loop, so that the program has one copy of the step.
            carry = jax.lax.fori_loop(0, num_steps, lambda _, carry: one(carry), carry)
        qpos, qvel, act, warmstart, sensors, *left = carry
        data = self._data(qpos, qvel, act=act, ctrl=ctrl, sensordata=sensors)
        readings = self._readings(changed(self._mx, multipliers), data)
        return qpos, qvel, act, warmstart, qpos - first, *readings, *left

    def _mover(self, model: Any, multipliers: jax.Array) -> Callable[[Any], Any]:
        """Return a function that advances data by one time step; ``model`` is already changed."""
        del multipliers
        return partial(self._stages.step, model)

    def first(
        self, is_sampled: int, qpos: jax.Array, qvel: jax.Array, multipliers: jax.Array
    ) -> Arrays:
        """See ``Native.first``; omits forces if observations of such a state have none."""
        data = self._data(qpos, qvel)
        left: Arrays = ()
        if self._starts_with_forces if is_sampled else self._reads_forces:
            model = changed(self._passive, multipliers)
            forward = self._stages.forward(model, data)
            data = data.replace(sensordata=forward.sensordata)
            left = tuple(getattr(forward, name) for name in self._fields)
        return *self._readings(changed(self._mx, multipliers), data), *left

    def clearances(self, qpos: jax.Array) -> Arrays:
        """See ``Native.clearances``; separate geoms may have a distance instead of infinity."""
        data = mjx.kinematics(self._mx, self._data(qpos, jnp.zeros(self._model.nv)))
        contact = mjx.collision(self._mx, data)._impl.contact
        distances = contact.dist - contact.includemargin
        found = jnp.full(self._model.ngeom, jnp.inf)
        for geoms in contact.geom.T:
            found = found.at[geoms].min(distances)
        return (found,)

    def _readings(self, model: Any, data: Any) -> Arrays:
        """Return ``xpos, xquat, sensordata``; sensors of forces are those of ``data``."""
        if read_more_than_bodies(self._model):
            data = mjx.fwd_position(model, data)
            data = mjx.fwd_velocity(model, data)
        else:
            data = mjx.kinematics(model, data)
            data = mjx.com_pos(model, data)
            data = mjx.com_vel(model, data)
        if self._model.nsensor:
            data = mjx.sensor_pos(model, data)
            data = mjx.sensor_vel(model, data)
        return data.xpos, data.xquat, data.sensordata

    def _data(self, qpos: jax.Array, qvel: jax.Array, **fields: jax.Array) -> Any:
        data = mjx.make_data(self.simulated, impl="jax")
        return data.replace(qpos=qpos, qvel=qvel, **fields)


class Mjx(Xla):
    """The same with MuJoCo XLA's own steps."""

    has_own_stages = False


def changed(model: Any, multipliers: jax.Array) -> Any:
    """Return a model with dynamics changed by the multipliers, if any."""
    return model.tree_replace(multiplied(model, multipliers)) if len(multipliers) else model


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
