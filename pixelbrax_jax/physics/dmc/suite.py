"""DM Control's own environments, which take over states of ours."""

from __future__ import annotations

import math
import os
import sys
import warnings
from typing import Any

import numpy as np

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.physics.dmc.domains import FORMULAS
from pixelbrax_jax.physics.dmc.tasks import TASKS
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.viewpoints import camera_name
from pixelbrax_jax.types import PhysicsState
from pixelbrax_jax.validation import check_choice

_VARIABLE = "MUJOCO_GL"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


class SuiteEnv:
    """An environment of ``dm_control.suite`` that starts where one of ours does.

    ``size`` is height and width of pictures; None makes none and needs no OpenGL. Pictures are
    drawn larger by the root of ``samples``, a square number, and averaged, like option ``samples``
    of ``make``. The OpenGL that ``MUJOCO_GL`` selects also smooths edges.
    """

    def __init__(
        self,
        task: str,
        *,
        camera: str = "default",
        size: tuple[int, int] | None = None,
        samples: int = 1,
    ) -> None:
        row = TASKS[check_choice("task of the DM Control Suite", task, TASKS)]
        self._formulas, self._size = FORMULAS[task], size
        self._times = math.isqrt(samples)
        # The caller counts steps.
        options = {"random": 0, "time_limit": math.inf}
        self._env = _import_suite().load(row.domain, row.task, task_kwargs=options)
        self._env.reset()  # gives targets their sizes
        self._physics = self._env.physics
        actions = self._env.action_spec()
        self._low, self._high = actions.minimum, actions.maximum
        model = self._physics.model.ptr
        names = [camera_name(model, i) for i in range(model.ncam)]
        if camera == "default":
            self._camera = self._formulas.camera
        else:
            self._camera = names.index(check_choice(f"camera of {row.domain!r}", camera, names))
        if size is not None:
            self._check_pictures()

    @property
    def qpos(self) -> np.ndarray:
        """Joint positions (Q,) float64, in MuJoCo's order."""
        return np.array(self._physics.data.qpos)

    @property
    def qvel(self) -> np.ndarray:
        """Joint velocities (V,) float64, in MuJoCo's order."""
        return np.array(self._physics.data.qvel)

    def start(self, state: PhysicsState) -> None:
        """Start an episode with the positions, velocities and target of a state of our task."""
        self._move_target(np.asarray(state.engine.target, np.float64))
        with self._physics.reset_context():
            self._physics.data.qpos[:] = state.engine.qpos
            self._physics.data.qvel[:] = state.engine.qvel

    def step(self, action: np.ndarray) -> float:
        """Advance by one control step under an (A,) action in [-1, 1]; return the reward."""
        part = 0.5 * (np.clip(np.asarray(action, np.float64), -1.0, 1.0) + 1.0)
        timestep = self._env.step(self._low + part * (self._high - self._low))
        return float(timestep.reward)

    def observe(self) -> np.ndarray:
        """Return DM Control's observation, (S,) float32, its entries in their order."""
        parts = self._env.task.get_observation(self._physics).values()
        return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)

    def render(self) -> np.ndarray:
        """Draw the state by OpenGL: (height, width, 3) uint8."""
        if self._size is None:
            raise ValueError("size=None means no pictures; give their height and width.")
        (height, width), times = self._size, self._times
        image: np.ndarray = self._physics.render(
            height * times, width * times, camera_id=self._camera
        )
        blocks = image.reshape(height, times, width, times, 3)
        return np.floor(blocks.mean(axis=(1, 3)) + 0.5).astype(np.uint8)

    def close(self) -> None:
        """Free OpenGL's memory."""
        self._env.close()

    def _move_target(self, target: np.ndarray) -> None:
        model, kinds = self._physics.model, mujoco.mjtObj
        if name := self._formulas.target_body:
            body = model.name2id(name, "body")
            model.body_pos[body], model.body_quat[body] = target[:3], target[3:]
        for name in self._formulas.movable:
            for kind, places, axes in (
                (kinds.mjOBJ_GEOM, model.geom_pos, [0, 1, 2]),
                (kinds.mjOBJ_SITE, model.site_pos, [0, 1, 2]),
                (kinds.mjOBJ_LIGHT, model.light_pos, [0, 1]),  # it keeps its height
            ):
                if (found := mujoco.mj_name2id(model.ptr, kind, name)) >= 0:
                    places[found, axes] = target[axes]

    def _check_pictures(self) -> None:
        # GLFW, dm_control's choice if none is made, fails only later and less clearly.
        known = [*_DISPLAYS, _VARIABLE]
        if sys.platform == "linux" and not any(map(os.environ.get, known)):
            raise _no_opengl("there is no display.")
        try:
            self.render()
        except ValueError:  # the size
            raise
        except Exception as error:
            raise _no_opengl(error) from error


def _import_suite() -> Any:
    """Import ``dm_control.suite``, which loads the OpenGL of ``MUJOCO_GL``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are about dm_control's own code
            from dm_control import suite
    except ModuleNotFoundError as error:
        raise ImportError(
            f"dm_control cannot be imported: {error}; try: {install_extra('dmc')} on Python 3.11 "
            "or 3.12."
        ) from error
    except Exception as error:
        raise _no_opengl(error, "cannot be imported") from error
    return suite


def _no_opengl(why: object, what: str = "has no OpenGL") -> ImportError:
    chosen = os.environ.get(_VARIABLE)
    state = "unset" if chosen is None else repr(chosen)
    return ImportError(
        f"dm_control {what} with {_VARIABLE} {state}: {why} Set {_VARIABLE}=egl (a GPU's driver, "
        f"or Debian's libegl1 and libgl1-mesa-dri), {_VARIABLE}=osmesa (Debian's libosmesa6) or, "
        f"with a display, {_VARIABLE}=glfw; without pictures {_VARIABLE}=disable."
    )
