"""One pixel environment as a ``gymnasium.Env``."""

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
    """A Brax task seen through a camera.

    Seeded with s it is bitwise environment 0 of a ``GymnasiumVectorEnv`` that is seeded with s,
    as far as the two compiled programs agree in their last bit.

    ``reset()`` without a seed goes on to the next episode, whose initial state depends on nothing
    but the seed and the number of the episode.

    Time limits: the environment truncates after ``episode_length`` control steps, hence after
    ``episode_length / action_repeat`` calls of ``step``. ``max_episode_steps`` counts calls of
    ``step``, as everywhere in Gymnasium, and so does a ``TimeLimit``, which ``gymnasium.make``
    makes of it. Of those that are given, the limit that is reached first truncates; if none is, it
    is 1000 control steps.

    Observations are never overwritten, and may be written to: nothing reads them again.

    After ``close`` a ``reset`` opens the environment again.
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
            output: what observations are: ``"numpy"``, ``"torch"`` or ``"jax"`` arrays.
            render_mode: None, ``"rgb_array"``, or ``"human"`` for a window.
            render_height: pixels of ``render()``.
            render_width: pixels of ``render()``.
            max_episode_steps: time limit in calls of ``step``.
            **options: everything else that ``pixelbrax_jax.make`` takes, such as ``backend``,
                ``camera``, ``height``, ``width``, ``frame_stack``, ``obs_mode``,
                ``action_repeat`` and ``episode_length``.

        Raises:
            TypeError: an option is unknown; the message lists those there are.
            ValueError: an option is out of range; the message lists what is allowed.
            ImportError: a package is missing that ``output`` or ``render_mode`` needs.
            RuntimeError: this process is a fork that cannot run JAX.
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
        """Reset to an episode.

        Args:
            seed: s resets to episode 0 of ``jax.random.key(s)``; None goes on to the next, or
                draws a seed if there was none yet.
            options: ``{"state": state}`` goes on from a state of ``get_state``, and takes no
                seed; there are no others.

        Returns:
            The observation and the info of ``step``.

        Raises:
            TypeError: the seed is no integer, ``options`` no dict, or the state no ``EnvState``.
            ValueError: the seed is out of range, or given beside a state; the state is of another
                environment; or there are other options.
            RuntimeError: this process is a fork that cannot run JAX.
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
        """Act for ``action_repeat`` control steps.

        Args:
            action: (A,) floating point, a NumPy array, torch tensor or JAX array; rounded to
                float32 and clipped to [-1, 1].

        Returns:
            Observation, reward, terminated, truncated and an info of

            * ``episode_return``: float, sum of this episode's rewards so far,
            * ``episode_length``: int, control steps so far,
            * ``non_finite``: bool, the physics diverged and ended the episode.

        Raises:
            ResetNeeded: before the first reset, after ``close``, or when the episode has ended.
            RuntimeError: this process is a fork that cannot run JAX.
            TypeError: the action is not floating point.
            ValueError: the action has another shape, is on another device, or contains a NaN
                (in a NumPy array or CPU tensor; elsewhere a NaN ends the episode with
                ``non_finite``). Nothing was stepped.
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
        """Return an image of the present state.

        Returns:
            (render_height, render_width, 3) uint8 in mode ``"rgb_array"``; None in the other
            modes. A window is drawn by ``reset`` and ``step`` already.

        Raises:
            ResetNeeded: before the first reset, or after ``close``.
        """
        if self.render_mode != "rgb_array":
            return None
        return self._picture()

    def close(self) -> None:
        """Close the window and forget the state; the next ``reset`` opens both again."""
        if self._window is not None:
            self._window.close()
        self._stateful.forget()

    def _take_time_limit(self) -> None:
        """Let a ``TimeLimit`` around this environment have its way, unless a limit was given."""
        calls = None if self._stateful.is_limited else _time_limit_around(self)
        if calls is not None and calls > self._stateful.max_episode_steps:
            self._stateful.set_time_limit(calls * self._stateful.env.action_repeat)
            if self._spec is not None:
                self._spec.max_episode_steps = calls

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._picture())

    def _picture(self) -> np.ndarray:
        image: np.ndarray = to_numpy(self._stateful.render())[0]
        return image


def _time_limit_around(env: gymnasium.Env) -> int | None:
    """Return the least limit of the ``TimeLimit`` wrappers through which ``env`` is reset.

    ``gymnasium.make`` tells its ``max_episode_steps`` to such a wrapper alone, so that an
    environment with a limit of its own cannot know otherwise that a longer one was asked for.
    """
    limits: list[int] = []
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        # Of no other frame: to look at its variables may keep them alive.
        if frame.f_code is TimeLimit.reset.__code__:
            wrapper = frame.f_locals["self"]
            if wrapper.unwrapped is env:
                limits.append(wrapper._max_episode_steps)
        frame = frame.f_back
    return min(limits, default=None)


def _plain(info: dict[str, Any]) -> dict[str, Any]:
    """Return scalars as Python's own numbers, arrays as NumPy's."""
    arrays = {name: np.array(value) for name, value in info.items()}
    return {name: array if array.ndim else array.item() for name, array in arrays.items()}
