"""Provide one pixel environment as a ``gymnasium.Env``."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

from pixelbrax_gym.gymnasium.base import StatefulAdapter
from pixelbrax_gym.gymnasium.spaces import action_space, observation_space
from pixelbrax_gym.gymnasium.window import Window
from pixelbrax_gym.interop.export import exporter, to_numpy
from pixelbrax_gym.resets import check_seed, read_options
from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_jax.validation import check_choice

RENDER_MODES = ("human", "rgb_array")


class GymnasiumEnv(StatefulAdapter, gymnasium.Env):
    """A pixel task as a single environment.

    Seed s gives the episodes of environment 0 of a ``GymnasiumVectorEnv`` with seed s, except for
    the last bit where the two compiled programs differ. ``reset()`` without a seed starts the
    next episode, whose initial state depends only on the seed and the number of the episode.

    ``episode_length`` limits an episode in control steps, ``action_repeat`` of which make a call
    of ``step``. ``max_episode_steps`` and Gymnasium's ``TimeLimit`` count calls of ``step``. The
    limit reached first truncates the episode; without any it is 1000 control steps.

    Observations are never overwritten and may be written to. ``reset`` reopens the environment
    after ``close``. Methods raise a ``RuntimeError`` in a fork that cannot run JAX.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": list(RENDER_MODES),
        "render_fps": 20,
    }

    def __init__(
        self,
        task: str,
        *,
        output: str = "numpy",
        render_mode: str | None = None,
        render_height: int = 480,
        render_width: int = 480,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Build the environment; the first ``reset`` compiles.

        Args:
            task: one of ``pixelbrax_jax.list_envs()``.
            output: type of observations: ``"numpy"``, ``"torch"`` or ``"jax"`` arrays.
            render_mode: None, ``"rgb_array"``, or ``"human"`` for a window.
            render_height: height of ``render()`` in pixels.
            render_width: width of ``render()`` in pixels.
            max_episode_steps: time limit in calls of ``step``.
            **options: other options of ``pixelbrax_jax.make``, such as ``camera``.

        Raises:
            TypeError: an option is unknown.
            ValueError: an option is out of range.
            ImportError: ``output`` or ``render_mode`` needs a package that is not installed.
        """
        if render_mode is not None:
            check_choice("render_mode", render_mode, RENDER_MODES)
        self._export = exporter(output)
        self._stateful = StatefulEnv(
            GymnasiumEnv,
            task,
            options,
            single=True,
            max_episode_steps=max_episode_steps,
            render_size=(render_height, render_width),
        )
        env = self._stateful.env
        self.observation_space = observation_space(env.obs_spec)
        self.action_space = action_space(env.action_size)
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": self._stateful.fps}
        self._window: Window | None = None
        if render_mode == "human":
            self._window = Window(f"PixelBrax {task}", self._stateful.fps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return the observation and the info of ``step``.

        Args:
            seed: s starts episode 0 of ``jax.random.key(s)``; None starts the next episode, or
                samples a seed at the first reset.
            options: ``{"state": state}`` continues from a state of ``get_state``, without a seed.

        Raises:
            TypeError: ``seed`` is not an integer, ``options`` not a dict, or the state not an
                ``EnvState``.
            ValueError: ``seed`` is out of range or given with a state, the state does not fit this
                environment, or another option is given.
        """
        given = read_options(options, seed)
        self._take_time_limit()
        if not given:
            seed = None if seed is None else check_seed(seed)
            gymnasium.Env.reset(self, seed=seed)
        outputs = self._stateful.reset(seed, self.np_random, **given)
        self._show()
        return self._export(outputs["obs"]), _plain(outputs["info"])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply an action for ``action_repeat`` control steps.

        Args:
            action: (A,) floating point, a NumPy array, torch tensor or JAX array; rounded to
                float32 and clipped to [-1, 1].

        Returns:
            Observation, reward, terminated, truncated and info: ``episode_return`` (float, sum of
            the episode's rewards), ``episode_length`` (int, control steps) and ``non_finite``
            (bool, the physics diverged and ended the episode).

        Raises:
            ResetNeeded: before the first reset, after ``close``, or when the episode has ended.
            TypeError: the action is not floating point.
            ValueError: the action's shape or device is wrong, or a NumPy array or CPU tensor
                contains NaN; nothing is stepped then. NaN elsewhere ends the episode.
        """
        outputs = self._stateful.step(action)
        self._show()
        return (
            self._export(outputs["obs"]),
            float(outputs["reward"]),
            bool(outputs["terminated"]),
            bool(outputs["truncated"]),
            _plain(outputs["info"]),
        )

    def render(self) -> np.ndarray | None:
        """Render a (render_height, render_width, 3) uint8 image of the current state.

        Returns None except in mode ``"rgb_array"``; ``reset`` and ``step`` update a window.

        Raises:
            ResetNeeded: before the first reset, or after ``close``.
        """
        if self.render_mode != "rgb_array":
            return None
        return self._picture()

    def close(self) -> None:
        """Close the window and release the state; the next ``reset`` reopens both."""
        if self._window is not None:
            self._window.close()
        self._stateful.forget()

    def _take_time_limit(self) -> None:
        """Adopt a longer limit of a ``TimeLimit`` around this environment unless one was given."""
        calls = None if self._stateful.is_limited else _time_limit_around(self)
        if calls is not None and calls > self._stateful.max_episode_steps:
            self._stateful.set_time_limit(calls * self._stateful.env.action_repeat)
            if self._spec is not None:
                self._spec.max_episode_steps = self._stateful.max_episode_steps

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._picture())

    def _picture(self) -> np.ndarray:
        image: np.ndarray = to_numpy(self._stateful.render())[0]
        return image


def _time_limit_around(env: gymnasium.Env) -> int | None:
    """Return the smallest limit of the ``TimeLimit`` wrappers through which ``env`` is reset.

    ``gymnasium.make`` passes ``max_episode_steps`` only to such a wrapper, not to the environment.
    """
    limits: list[int] = []
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        # Reading the variables of any other frame may keep them alive.
        if frame.f_code is TimeLimit.reset.__code__:
            wrapper = frame.f_locals["self"]
            if wrapper.unwrapped is env:
                limits.append(wrapper._max_episode_steps)
        frame = frame.f_back
    return min(limits, default=None)


def _plain(info: dict[str, Any]) -> dict[str, Any]:
    """Convert scalars to Python's numbers and arrays to NumPy's."""
    arrays = {name: np.array(value) for name, value in info.items()}
    return {name: array if array.ndim else array.item() for name, array in arrays.items()}
