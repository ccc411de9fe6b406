"""MuJoCo's own engine: steps of many environments, in threads."""

from __future__ import annotations

import copy
import os
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco

READINGS = (
    *("xpos", "xquat", "xmat", "xipos", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat"),
    *("subtree_com", "sensordata"),
)
"""What is read of ``MjData`` after a step."""

_FEWEST = 8
"""Environments that are worth a thread."""

_STATE = int(
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_ACT
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_CTRL
)
"""What a step depends on, in MuJoCo's order of a state."""


class _Worker(NamedTuple):
    """A model and data for one thread, and views of what is read."""

    model: mujoco.MjModel
    data: mujoco.MjData
    readings: tuple[np.ndarray, ...]


class Native:
    """Steps of a model, for rows of environments.

    A method takes (N, ...) arrays and fills its last ones. It may run in several threads at once.
    The result of a row depends on nothing but the row.
    """

    def __init__(self, model: mujoco.MjModel, target_body: int | None):
        """Take a model; ``target_body`` is a body that targets of (7,) move."""
        self._model = model
        self._target_body = target_body
        self._idle: queue.SimpleQueue[_Worker] = queue.SimpleQueue()

    def step(self, num_steps: int, *arrays: np.ndarray) -> None:
        """Advance ``qpos, qvel, act, qacc_warmstart, ctrl, target`` by physics steps.

        Fills the first four, and ``READINGS``. Positions, velocities and their sensors are those
        after the last step; sensors of forces and accelerations those of its beginning.
        """
        state, (_, target, *results) = _join(arrays[:5]), arrays[4:]
        moved, readings = results[:4], results[4:]

        def row(worker: _Worker, i: int) -> None:
            model, data = worker.model, worker.data
            mujoco.mj_setState(model, data, state[i], _STATE)
            self._place_target(model, target, i)
            mujoco.mj_step(model, data, num_steps)
            mujoco.mj_step1(model, data)
            mujoco.mj_getState(model, data, state[i], _STATE)
            _read(worker, readings, i)

        self._for_rows(len(state), row)
        _split(state, moved)

    def first(self, *arrays: np.ndarray) -> None:
        """Compute what ``qpos, qvel, target`` say, with actuators off, as DM Control's resets do.

        Fills ``qacc_warmstart``, the accelerations, and ``READINGS``.
        """
        (qpos, qvel, target, warmstart), readings = arrays[:4], arrays[4:]
        others = self._model.na + self._model.nv + self._model.nu
        state = _join([qpos, qvel, np.zeros((len(qpos), others))])
        off = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)

        def row(worker: _Worker, i: int) -> None:
            model, data = worker.model, worker.data
            mujoco.mj_setState(model, data, state[i], _STATE)
            self._place_target(model, target, i)
            before = model.opt.disableflags
            model.opt.disableflags |= off
            try:
                mujoco.mj_forward(model, data)
            finally:
                model.opt.disableflags = before
            warmstart[i] = data.qacc
            _read(worker, readings, i)

        self._for_rows(len(qpos), row)

    def clearances(self, qpos: np.ndarray, found: np.ndarray) -> None:
        """Fill (N, G) metres, by which each geom overlaps another, negative; infinity for none."""
        found[:] = np.inf

        def row(worker: _Worker, i: int) -> None:
            worker.data.qpos = qpos[i]
            mujoco.mj_fwdPosition(worker.model, worker.data)
            contact = worker.data.contact
            distances = contact.dist - contact.includemargin
            for geoms in contact.geom.T:
                np.minimum.at(found[i], geoms, distances)

        self._for_rows(len(qpos), row)

    def _place_target(self, model: mujoco.MjModel, target: np.ndarray, i: int) -> None:
        if self._target_body is not None:
            model.body_pos[self._target_body] = target[i, :3]
            model.body_quat[self._target_body] = target[i, 3:]

    def _for_rows(self, num_rows: int, row: Callable[[_Worker, int], None]) -> None:
        def block(start: int, stop: int) -> None:
            with self._worker() as worker:
                for i in range(start, stop):
                    row(worker, i)

        num_blocks = max(1, min(_num_threads(), num_rows // _FEWEST))
        edges = [num_rows * k // num_blocks for k in range(num_blocks + 1)]
        others = [_pool().submit(block, *edge) for edge in zip(edges[1:], edges[2:], strict=False)]
        block(*edges[:2])
        for other in others:
            other.result()

    @contextmanager
    def _worker(self) -> Iterator[_Worker]:
        try:
            worker = self._idle.get_nowait()
        except queue.Empty:
            model = copy.copy(self._model)
            # A state that diverges stays as it is, for `GuardedPhysics` to find.
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
            data = mujoco.MjData(model)
            # MuJoCo prints, and writes to a file, the first warning of a kind.
            data.warning.number[:] = 1
            worker = _Worker(model, data, _views(data))
        try:
            yield worker
        finally:
            self._idle.put(worker)


def shapes_of_readings(model: mujoco.MjModel) -> list[tuple[int, ...]]:
    """Return the shapes of ``READINGS``."""
    return [view.shape for view in _views(mujoco.MjData(model))]


def _views(data: mujoco.MjData) -> tuple[np.ndarray, ...]:
    """Return views of ``READINGS``, with matrices of (3, 3)."""
    views = [getattr(data, name) for name in READINGS]
    return tuple(view.reshape(-1, 3, 3) if view.shape[1:] == (9,) else view for view in views)


def _join(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(arrays, axis=1, dtype=np.float64)


def _split(state: np.ndarray, parts: Sequence[np.ndarray]) -> None:
    start = 0
    for part in parts:
        part[:] = state[:, start : start + part.shape[1]]
        start += part.shape[1]


def _read(worker: _Worker, readings: Sequence[np.ndarray], i: int) -> None:
    for reading, value in zip(readings, worker.readings, strict=True):
        reading[i] = value


def _num_threads() -> int:
    available = getattr(os, "sched_getaffinity", None)
    return len(available(0)) if available else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_num_threads(), thread_name_prefix="pixelbrax-mujoco")


# A forked process has the pool, but none of its threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
