"""MuJoCo's own engine: steps of many environments, in threads."""

from __future__ import annotations

import copy
import os
import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from pixelbrax_jax.physics.mujoco.compatibility import loading_silenced
from pixelbrax_jax.physics.mujoco.opengl import mujoco

from mujoco.rollout import Rollout  # isort: skip  # MuJoCo is imported without OpenGL above

_FEWEST = 16
"""Environments for which other threads are worth waking."""

_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_OFF = mujoco.mjtDisableBit

_Thing = TypeVar("_Thing")


class Native:
    """Steps of a model, for rows of environments.

    A method takes (N, ...) float32 arrays and fills its last ones. It may run in several threads at
    once. The result of a row depends on nothing but the row. A row that diverges becomes NaN.
    """

    def __init__(self, model: mujoco.MjModel, posed: mujoco.MjModel, *, reads_forces: bool):
        """Take a model and the same ``with_poses``; compile nothing."""
        # A state that diverges stays as it is.
        disabled = _OFF.mjDSBL_AUTORESET
        self._moving = _without(model, disabled if reads_forces else disabled | _OFF.mjDSBL_SENSOR)
        self._resting = _without(posed, disabled | _OFF.mjDSBL_ACTUATION)
        self._still = _without(
            posed,
            disabled | _OFF.mjDSBL_ACTUATION | _OFF.mjDSBL_CONSTRAINT | _OFF.mjDSBL_CONTACT,
        )
        self._still.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        if mujoco.mj_stateSize(model, _STATE) != 1 + model.nq + model.nv + model.na:
            raise ValueError("MuJoCo's plugins and delays are not simulated: remove them.")
        stages = np.repeat(model.sensor_needstage, model.sensor_dim)
        self._is_force = stages == int(mujoco.mjtStage.mjSTAGE_ACC)
        self._rest = np.concatenate([[0], model.qpos0, np.zeros(model.nv + model.na)])
        self._idle: dict[int, queue.SimpleQueue[list[mujoco.MjData]]] = {}

    def step(self, num_steps: int, *arrays: np.ndarray) -> None:
        """Advance ``qpos, qvel, act, qacc_warmstart, ctrl`` by at least one physics step.

        Fills the first four, and ``xpos``, ``xquat`` and ``sensordata``. Positions, velocities and
        their sensors are those after the last step; sensors of forces and accelerations those of
        its beginning. The accelerations are those of the last step, from its velocities.
        """
        model = self._moving
        qpos, qvel, act, warmstart, ctrl, *results = arrays
        is_bad = ~(np.abs(ctrl) < mujoco.mjMAXVAL).all(axis=1)
        ctrl = np.where(is_bad[:, None], 0, ctrl)  # MuJoCo would do so without an error
        first = np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel, act], 1, dtype=np.float64)
        states, sensors = self._roll(
            model, first, num_steps, ctrl.astype(np.float64), warmstart.astype(np.float64)
        )
        last = states[:, -1]
        # MuJoCo ends a row's steps where it warns.
        is_bad |= np.abs(last[:, 0] - num_steps * model.opt.timestep) > model.opt.timestep / 2
        last[is_bad] = self._rest
        edges = np.cumsum([1, model.nq, model.nv, model.na])
        for result, start, stop in zip(results, edges, edges[1:], strict=False):
            result[:] = last[:, start:stop]
        before = states[:, -2] if num_steps > 1 else first
        velocities = slice(edges[1], edges[2])
        results[3][:] = (last[:, velocities] - before[:, velocities]) / model.opt.timestep
        for result in results[:4]:
            result[is_bad] = np.nan
        _, found = self._roll(self._still, last, 1)
        self._read(found[:, 0], *results[4:])
        results[6][:, self._is_force] = sensors[:, -1, self._is_force]

    def first(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        xpos: np.ndarray,
        xquat: np.ndarray,
        sensordata: np.ndarray,
    ) -> None:
        """Compute what ``qpos`` and ``qvel`` say, with actuators off, as DM Control's resets do.

        Fills ``xpos``, ``xquat`` and ``sensordata``.
        """
        parts = [np.zeros((len(qpos), 1)), qpos, qvel, np.zeros((len(qpos), self._moving.na))]
        _, found = self._roll(self._resting, np.concatenate(parts, 1, dtype=np.float64), 1)
        self._read(found[:, 0], xpos, xquat, sensordata)

    def clearances(self, qpos: np.ndarray, found: np.ndarray) -> None:
        """Fill (N, G) metres, by which each geom overlaps another, negative; infinity for none."""
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
        num_threads = _num_threads() if num_rows >= _FEWEST else 1
        with (
            _rollout(num_threads) as rollout,
            self._data(model, max(1, rollout.nthread)) as data,
        ):
            rollout.rollout(
                [model] * num_rows,
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

    def _read(
        self, found: np.ndarray, xpos: np.ndarray, xquat: np.ndarray, own: np.ndarray
    ) -> None:
        own[:] = found[:, : own.shape[1]]
        poses = found[:, own.shape[1] :].reshape(len(found), -1, 7)
        xpos[:, 0], xquat[:, 0] = 0, (1, 0, 0, 0)
        xpos[:, 1:], xquat[:, 1:] = poses[..., :3], poses[..., 3:]

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


def with_poses(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model that also senses the poses of all bodies but the world."""
    spec = spec.copy()
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body/{i}"
    for body in spec.bodies[1:]:
        for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body.name)
    return compile_model(spec)


def _without(model: mujoco.MjModel, features: int) -> mujoco.MjModel:
    model = copy.copy(model)
    model.opt.disableflags |= int(features)
    return model


def _num_threads() -> int:
    available = getattr(os, "sched_getaffinity", None)
    return len(available(0)) if available else os.cpu_count() or 1


_pools: queue.SimpleQueue[Rollout] = queue.SimpleQueue()
"""Thread pools that nobody uses."""
_abandoned: list[object] = []
_in_this_thread = Rollout(nthread=0)


def _forget_pools() -> None:
    """In a forked process: pools without threads must not be used, nor be deleted."""
    global _pools
    _abandoned.append(_pools)
    _pools = queue.SimpleQueue()


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
