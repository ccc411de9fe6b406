"""MuJoCo's own engine: steps of many environments, in threads."""

from __future__ import annotations

import copy
import os
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from pixelbrax_jax.physics.mujoco.compatibility import loading_silenced
from pixelbrax_jax.physics.mujoco.multipliers import MultipliedModels
from pixelbrax_jax.physics.mujoco.needs import Needs
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.sensors import read_actuators, read_constraints
from pixelbrax_jax.processor import num_cores

from mujoco.rollout import Rollout  # isort: skip  # MuJoCo is imported without OpenGL above

_FEWEST = 16
"""Environments for which other threads are worth waking."""

_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_OFF = mujoco.mjtDisableBit

_Thing = TypeVar("_Thing")
_Models = Sequence[mujoco.MjModel]


class Native:
    """Steps of a model, for rows of environments.

    A method takes (N, ...) float32 arrays and fills its last ones. It may run in several threads at
    once. The result of a row depends on nothing but the row. A row that diverges becomes NaN.
    """

    def __init__(self, model: mujoco.MjModel, posed: mujoco.MjModel, needs: Needs):
        """Take a model, and the same model compiled ``with_poses``."""
        self._fields = needs.reads
        # A state that diverges stays as it is.
        disabled = _OFF.mjDSBL_AUTORESET
        unread = disabled if needs.reads_forces else disabled | _OFF.mjDSBL_SENSOR
        self._moving = _without(model, unread)
        self._resting = _without(posed, disabled | _OFF.mjDSBL_ACTUATION)
        self._reads_actuators = read_actuators(model)
        still = disabled
        if not self._reads_actuators:
            still |= _OFF.mjDSBL_ACTUATION
        if not read_constraints(model):
            still |= _OFF.mjDSBL_CONSTRAINT | _OFF.mjDSBL_CONTACT
        self._still = _without(posed, still)
        self._still.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        if mujoco.mj_stateSize(model, _STATE) != 1 + model.nq + model.nv + model.na:
            raise ValueError("MuJoCo's plugins and delays are not simulated: remove them.")
        clocks = np.flatnonzero(model.sensor_type == int(mujoco.mjtSensor.mjSENS_CLOCK))
        if len(clocks):
            names = ", ".join(repr(model.sensor(i).name or f"sensor/{i}") for i in clocks)
            raise ValueError(f"sensor {names} is a clock, and states have no time: remove it.")
        self._senses = not model.opt.disableflags & _OFF.mjDSBL_SENSOR
        stages = np.repeat(model.sensor_needstage, model.sensor_dim)
        self._is_force = stages == int(mujoco.mjtStage.mjSTAGE_ACC)
        self._rest = np.concatenate([[0], model.qpos0, np.zeros(model.nv + model.na)])
        self._idle: dict[int, queue.SimpleQueue[list[mujoco.MjData]]] = {}
        self._multiplied: dict[int, queue.SimpleQueue[MultipliedModels]] = {}

    def step(self, num_steps: int, *arrays: np.ndarray) -> None:
        """Advance ``qpos, qvel, act, qacc_warmstart, ctrl`` by at least one physics step.

        The sixth array has multipliers of the dynamics, or no columns. Fills the first four, the
        change of ``qpos``, and ``xpos``, ``xquat`` and ``sensordata``, for the times that
        ``Snapshot`` states. The accelerations are those of the last step, from its velocities. Then
        it fills the fields, as the last step and ``mj_rnePostConstraint`` leave them.
        """
        model = self._moving
        qpos, qvel, act, warmstart, ctrl, multipliers, *results = arrays
        is_bad = ~(np.abs(ctrl) < mujoco.mjMAXVAL).all(axis=1)
        ctrl = np.where(is_bad[:, None], 0, ctrl)  # MuJoCo would do so without an error
        first = np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel, act], 1, dtype=np.float64)
        moved, xpos, xquat, sensordata, *fields = results[4:]
        begin = first, ctrl.astype(np.float64), warmstart.astype(np.float64)
        with self._models(model, multipliers) as models:
            if fields:
                last, qacc, sensors = self._step_each(models, num_steps, *begin, fields)
            else:
                last, qacc, sensors = self._step_all(models, num_steps, *begin)
        # MuJoCo may end a row's steps early at a warning.
        is_bad |= np.abs(last[:, 0] - num_steps * model.opt.timestep) > model.opt.timestep / 2
        is_bad |= ~(np.abs(qacc) < mujoco.mjMAXVAL).all(axis=1)
        last[is_bad] = self._rest
        edges = np.cumsum([1, model.nq, model.nv, model.na])
        for result, start, stop in zip(results, edges, edges[1:], strict=False):
            result[:] = last[:, start:stop]
        results[3][:] = qacc
        for result in results[:4]:
            result[is_bad] = np.nan
        moved[:] = (last - first)[:, edges[0] : edges[1]]
        with self._models(self._still, multipliers) as models:
            _, found = self._roll(self._still, models, last, 1)
        self._read(found[:, 0], xpos, xquat, sensordata)
        sensordata[:, self._is_force] = sensors[:, self._is_force]

    def _step_all(
        self,
        models: _Models,
        num_steps: int,
        first: np.ndarray,
        ctrl: np.ndarray,
        warmstart: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the last states, accelerations from their velocities, and sensors."""
        model = self._moving
        states, sensors = self._roll(model, models, first, num_steps, ctrl, warmstart)
        last, before = states[:, -1], states[:, -2] if num_steps > 1 else first
        velocities = slice(1 + model.nq, 1 + model.nq + model.nv)
        qacc = (last - before)[:, velocities] / model.opt.timestep
        return last, qacc, sensors[:, -1]

    def _step_each(
        self,
        models: _Models,
        num_steps: int,
        first: np.ndarray,
        ctrl: np.ndarray,
        warmstart: np.ndarray,
        fields: Sequence[np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same, with MuJoCo's own accelerations, and fill the fields."""
        last, qacc = first.copy(), warmstart
        sensors = np.empty((len(first), self._moving.nsensordata))

        def step(data: mujoco.MjData, i: int) -> None:
            data.ctrl, data.qacc_warmstart = ctrl[i], warmstart[i]
            mujoco.mj_step(models[i], data, num_steps)
            mujoco.mj_rnePostConstraint(models[i], data)
            mujoco.mj_getState(models[i], data, last[i], _STATE)
            qacc[i], sensors[i] = data.qacc_warmstart, data.sensordata

        self._fill(fields, first, step)
        return last, qacc, sensors

    def first(
        self,
        is_sampled: int,
        qpos: np.ndarray,
        qvel: np.ndarray,
        multipliers: np.ndarray,
        *results: np.ndarray,
    ) -> None:
        """Fill readings of ``qpos`` and ``qvel`` with actuators off, as DM Control's resets do.

        Forces are computed for all states; ``is_sampled`` is ignored.
        """
        del is_sampled
        xpos, xquat, sensordata, *fields = results
        parts = [np.zeros((len(qpos), 1)), qpos, qvel, np.zeros((len(qpos), self._moving.na))]
        first = np.concatenate(parts, 1, dtype=np.float64)
        with self._models(self._resting, multipliers) as models:
            _, found = self._roll(self._resting, models, first, 1)
        self._read(found[:, 0], xpos, xquat, sensordata)
        if self._reads_actuators and self._senses:
            # Actuators that are off have no velocities.
            with self._models(self._still, multipliers) as models:
                _, found = self._roll(self._still, models, first, 1)
            own = found[:, 0, : sensordata.shape[1]]
            sensordata[:, ~self._is_force] = own[:, ~self._is_force]
        if fields:
            with self._models(self._moving, multipliers) as models:
                self._fill(fields, first, partial(self._look, models))

    @staticmethod
    def _look(models: _Models, data: mujoco.MjData, i: int) -> None:
        data.ctrl, data.cfrc_ext, data.qacc_warmstart = 0, 0, 0
        mujoco.mj_forward(models[i], data)

    def _fill(
        self,
        fields: Sequence[np.ndarray],
        states: np.ndarray,
        compute: Callable[[mujoco.MjData, int], None],
    ) -> None:
        """Fill fields of ``MjData`` after ``compute`` of each state's data and row."""

        def block(start: int, stop: int) -> None:
            with self._data(self._moving, 1) as (data,):
                views = [getattr(data, name) for name in self._fields]
                for i in range(start, stop):
                    mujoco.mj_setState(self._moving, data, states[i], _STATE)
                    compute(data, i)
                    for field, view in zip(fields, views, strict=True):
                        field[i] = view

        count = _num_threads(len(states))
        edges = [len(states) * k // count for k in range(count + 1)]
        others = [_threads().submit(block, *edge) for edge in pairwise(edges[1:])]
        try:
            block(*edges[:2])
        finally:
            # The threads write to arrays that live no longer than this call.
            wait(others)
        for other in others:
            other.result()

    def _read(
        self, found: np.ndarray, xpos: np.ndarray, xquat: np.ndarray, own: np.ndarray
    ) -> None:
        """Fill poses and sensors from the sensors of a model ``with_poses``."""
        own[:] = found[:, : own.shape[1]] if self._senses else 0
        poses = found[:, own.shape[1] :].reshape(len(found), -1, 7)
        xpos[:, 0], xquat[:, 0] = 0, (1, 0, 0, 0)
        xpos[:, 1:], xquat[:, 1:] = poses[..., :3], poses[..., 3:]

    def clearances(self, qpos: np.ndarray, found: np.ndarray) -> None:
        """Fill (N, G) metres: negative where a geom overlaps another, infinity without contact."""
        found[:] = np.inf
        with self._data(self._moving, 1) as (data,):
            for row, distances in zip(qpos, found, strict=True):
                data.qpos = row
                mujoco.mj_fwdPosition(self._moving, data)
                contact = data.contact
                for geoms in contact.geom.T:
                    np.minimum.at(distances, geoms, contact.dist - contact.includemargin)

    def _roll(
        self,
        model: mujoco.MjModel,
        models: _Models,
        first: np.ndarray,
        num_steps: int,
        ctrl: np.ndarray | None = None,
        warmstart: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, num_steps, ...) states after each step, and sensors before it."""
        num_rows = len(first)
        controls = None
        if ctrl is not None:
            controls = np.repeat(ctrl[:, None], num_steps, axis=1)
        states = np.empty((num_rows, num_steps, first.shape[1]))
        sensors = np.empty((num_rows, num_steps, model.nsensordata))
        with (
            _rollout(_num_threads(num_rows)) as rollout,
            self._data(model, max(1, rollout.nthread)) as data,
        ):
            rollout.rollout(
                models,
                data,
                np.ascontiguousarray(first),
                controls,
                nstep=num_steps,
                initial_warmstart=warmstart,
                state=states,
                sensordata=sensors,
                skip_checks=True,
            )
        return states, sensors

    @contextmanager
    def _models(self, model: mujoco.MjModel, multipliers: np.ndarray) -> Iterator[_Models]:
        """Yield a model for each row of (N, 5) or (N, 0) multipliers."""
        if not multipliers.shape[1]:
            yield [model] * len(multipliers)
            return
        idle = self._multiplied.setdefault(id(model), queue.SimpleQueue())
        with _borrowed(idle, lambda: MultipliedModels(model)) as models:
            yield models.of_rows(multipliers)

    @contextmanager
    def _data(self, model: mujoco.MjModel, count: int) -> Iterator[list[mujoco.MjData]]:
        idle = self._idle.setdefault(id(model), queue.SimpleQueue())
        with _borrowed(idle, list) as data:
            while len(data) < count:
                data.append(mujoco.MjData(model))
            yield data[:count]


def compile_model(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model without MuJoCo's known warnings."""
    with loading_silenced():
        return spec.compile()


def without_textures(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy without textures, which take most of a model's memory."""
    spec = spec.copy()
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)
    return spec


def with_poses(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model that senses the poses of all bodies but the world, whatever its flags."""
    spec = spec.copy()
    spec.option.disableflags &= ~int(_OFF.mjDSBL_SENSOR)
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"pixelbrax/body/{i}"
    for body in spec.bodies[1:]:
        for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body.name)
    return compile_model(spec)


def _without(model: mujoco.MjModel, features: int) -> mujoco.MjModel:
    model = copy.copy(model)
    model.opt.disableflags |= int(features)
    # Otherwise a sensor of kinetic energy keeps the value of an earlier row with the same data.
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    return model


def _num_threads(num_rows: int) -> int:
    return num_cores() if num_rows >= _FEWEST else 1


_pools: queue.SimpleQueue[Rollout] = queue.SimpleQueue()
"""Idle thread pools."""
_abandoned: list[object] = []
_in_this_thread = Rollout(nthread=0)


def _forget_pools() -> None:
    """In a fork, where pools have no threads, neither use nor delete them."""
    global _pools
    _abandoned.append(_pools)
    _pools = queue.SimpleQueue()
    _threads.cache_clear()


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_cores(), thread_name_prefix="pixelbrax-mujoco")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)


@contextmanager
def _rollout(num_threads: int) -> Iterator[Rollout]:
    if num_threads == 1:
        yield _in_this_thread
    else:
        with _borrowed(_pools, lambda: Rollout(nthread=num_threads)) as pool:
            yield pool


@contextmanager
def _borrowed(idle: queue.SimpleQueue[_Thing], make: Callable[[], _Thing]) -> Iterator[_Thing]:
    try:
        thing = idle.get_nowait()
    except queue.Empty:
        thing = make()
    try:
        yield thing
    finally:
        idle.put(thing)
