"""One pixel environment as a ``gymnasium.Env``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from pixelbrax_gym.gymnasium.spaces import action_space, observation_space
from pixelbrax_gym.gymnasium.specs import complete_spec, time_limit_around
from pixelbrax_gym.gymnasium.window import Window
from pixelbrax_gym.interop.export import exporter, to_numpy
from pixelbrax_gym.reset_options import check_reset_options
from pixelbrax_gym.seeds import check_seed, check_unseeded
from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.types import EnvState
from pixelbrax_jax.validation import check_choice, check_positive_int

RENDER_MODES = ("human", "rgb_array")

_OWN_OPTIONS = ("output", "render_mode", "render_height", "render_width", "max_episode_steps")


class GymnasiumEnv(gymnasium.Env):
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
            task,
            options,
            single=True,
            max_episode_steps=max_episode_steps,
            also_allowed=_OWN_OPTIONS,
        )
        env = self._stateful.env
        self.observation_space = observation_space(env.obs_spec)
        self.action_space = action_space(env.action_size)
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": self._stateful.fps}
        self._render_size = check_render_size(render_height, render_width)
        self._spec: EnvSpec | None = None
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
        check_reset_options(options, ("state",))
        self._take_time_limit()
        if options:
            check_unseeded(seed)
            outputs = self._stateful.set_state(options["state"])
        else:
            seed = None if seed is None else check_seed(seed)
            super().reset(seed=seed)
            outputs = self._stateful.reset(seed, self.np_random)
        self._show()
        return self._export(outputs["obs"]), _plain(outputs["info"])

    def get_state(self) -> EnvState:
        """Return the present state.

        Returns:
            An ``EnvState`` of arrays that nothing writes to, with all that decides how the episode
            and the later ones go on, but for a ``TimeLimit`` around the environment. It can be
            pickled, and ``reset(options={"state": state})`` goes on from it to the bit.

        Raises:
            ResetNeeded: before the first reset, or after ``close``.
        """
        return self._stateful.get_state()

    def set_state(self, state: EnvState) -> None:
        """Go on from a given state, as ``reset(options={"state": state})`` does.

        Args:
            state: what ``get_state`` returned here or of another environment of the same options,
                or ``PixelEnv.reset`` or ``step`` did.

        Raises:
            TypeError: it is no ``EnvState``.
            ValueError: it is of another environment; the message names the first difference.
        """
        self._stateful.set_state(state)

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

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium knows of the environment, with its time limit in calls of ``step``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = complete_spec(spec, self._stateful, self._stateful.is_limited)

    def _take_time_limit(self) -> None:
        """Let a ``TimeLimit`` around this environment have its way, unless a limit was given."""
        calls = None if self._stateful.is_limited else time_limit_around(self)
        if calls is not None and calls > self._stateful.max_episode_steps:
            self._stateful.set_time_limit(calls * self._stateful.env.action_repeat)
            if self._spec is not None:
                self._spec.max_episode_steps = calls

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._picture())

    def _picture(self) -> np.ndarray:
        image: np.ndarray = to_numpy(self._stateful.render(*self._render_size))[0]
        return image


def check_render_size(height: Any, width: Any) -> tuple[int, int]:
    """Return the size of an image that ``render()`` draws.

    Raises:
        ValueError: it is not a pair of integers of at least 1.
        MemoryError: an image would not fit into this machine's memory.
    """
    size = check_positive_int("render_height", height), check_positive_int("render_width", width)
    check_fits(f"render_height={height}, render_width={width}", 3 * size[0] * size[1])
    return size


def _plain(info: dict[str, Any]) -> dict[str, Any]:
    """Return scalars as Python's own numbers, arrays as NumPy's."""
    arrays = {name: np.array(value) for name, value in info.items()}
    return {name: array if array.ndim else array.item() for name, array in arrays.items()}
