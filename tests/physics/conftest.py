"""Programs shared by the physics tests: each is compiled once per session."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco_compatibility import loading_silenced
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.types import Geoms

# Tests look at a few steps; compiling takes longer than running, so it is done hastily.
_HASTY = {"xla_backend_optimization_level": 0}


class Program:
    """Compiled functions of one ``Physics``."""

    def __init__(self, physics: Any):
        self.physics = physics
        self.traces = 0

    @cached_property
    def reset(self) -> Callable:
        return jax.jit(self.physics.reset, compiler_options=_HASTY)

    @cached_property
    def from_qpos(self) -> Callable:
        return jax.jit(self.physics.from_qpos, compiler_options=_HASTY)

    @cached_property
    def step(self) -> Callable:
        def counted(state: Any, action: Any) -> Any:
            self.traces += 1
            return self.physics.step(state, action)

        return jax.jit(counted, compiler_options=_HASTY)


@cache
def _program(task: str, backend: str | None, reward_preset: str) -> Program:
    return Program(make_physics(task, backend=backend, reward_preset=reward_preset))


@pytest.fixture(scope="session")
def program() -> Callable[..., Program]:
    """``program(task, backend=None, reward_preset="brax")``, the same one every time."""

    def build(task: str, backend: str | None = None, reward_preset: str = "brax") -> Program:
        return _program(task, backend, reward_preset)

    return build


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


@cache
def _unfused_model(task: str) -> mujoco.MjModel:
    name = {"halfcheetah": "half_cheetah"}.get(task, task)
    (folder,) = find_spec("brax").submodule_search_locations
    with loading_silenced():
        return mujoco.MjModel.from_xml_path(str(Path(folder) / "envs" / "assets" / f"{name}.xml"))


@pytest.fixture(scope="session")
def unfused_model() -> Callable[[str], mujoco.MjModel]:
    """A task's model as MuJoCo reads it, without Brax's rewriting."""
    return _unfused_model
