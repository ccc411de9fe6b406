"""Programs shared by the physics tests: each is compiled once per session."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco.compatibility import loading_silenced
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.types import Geoms

# Tests look at a few steps; compiling takes longer than running, so it is done hastily.
_HASTY = {"xla_backend_optimization_level": 0}


class Program:
    """Compiled functions of one ``Physics``."""

    def __init__(self, physics: Any):
        self.physics = physics
        self.traces = 0
        self.reset, self.from_qpos, self.step = (
            jax.jit(function, compiler_options=_HASTY)
            for function in (physics.reset, physics.from_qpos, self._counted_step)
        )

    def _counted_step(self, state: Any, action: Any) -> Any:
        self.traces += 1
        return self.physics.step(state, action)


@pytest.fixture(scope="session")
def program() -> Callable[..., Program]:
    """``program(task, backend=None, preset="brax")``, the same one every time."""

    @cache
    def cached(task: str, backend: str | None, reward_preset: str) -> Program:
        return Program(make_physics(task, backend=backend, reward_preset=reward_preset))

    return lambda task, backend=None, preset="brax": cached(task, backend, preset)


@pytest.fixture(scope="session")
def compiled() -> Callable[[Any], Program]:
    """Compiled functions of a ``Physics`` of the test's own."""
    return Program


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """(3, 3) float64 by MuJoCo, independent of the package."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, np.float64))
    return matrix.reshape(3, 3)


@pytest.fixture(scope="session")
def geom_pose() -> Callable[[Geoms, Any, int], tuple[np.ndarray, np.ndarray]]:
    """World center (3,) and orientation (3, 3) of geom ``index`` in a ``PhysicsState``."""

    def pose(geoms: Geoms, state: Any, index: int) -> tuple[np.ndarray, np.ndarray]:
        pos, mat = np.asarray(geoms.pos[index]), rotation_matrix(geoms.quat[index])
        link = geoms.link[index]
        if link < 0:
            return pos, mat
        link_mat = rotation_matrix(state.xquat[link])
        return np.asarray(state.xpos[link]) + link_mat @ pos, link_mat @ mat

    return pose


@pytest.fixture(scope="session")
def unfused_model() -> Callable[[str], mujoco.MjModel]:
    """A task's model as MuJoCo reads it, without Brax's rewriting."""

    @cache
    def read(task: str) -> mujoco.MjModel:
        name = {"halfcheetah": "half_cheetah"}.get(task, task)
        path = Path(find_spec("brax").origin).parent / "envs" / "assets" / f"{name}.xml"
        with loading_silenced():
            return mujoco.MjModel.from_xml_path(str(path))

    return read
