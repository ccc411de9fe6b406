"""Provide many pixel environments as a ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode

from pixelbrax_gym.gymnasium.base import StatefulAdapter
from pixelbrax_gym.gymnasium.spaces import action_space, observation_space
from pixelbrax_gym.interop.export import exporter, to_numpy
from pixelbrax_gym.resets import check_seed, read_options
from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_gym.sub_env import SubEnv, call_sub_envs
from pixelbrax_jax.validation import check_choice


class GymnasiumVectorEnv(StatefulAdapter, gymnasium.vector.VectorEnv):
    """``num_envs`` copies of a pixel task, stepped together.

    Environment i depends only on its seed, not on ``num_envs`` or the other environments.

    Autoreset modes, as in Gymnasium:

    * ``"next_step"`` (default): the step that ends an episode returns its last observation. The
      next step ignores that environment's action and returns the first observation of the
      next episode, reward 0 and both flags False.
    * ``"same_step"``: the step that ends an episode returns the first observation of the next;
      ``infos["final_obs"]`` and ``infos["final_info"]`` have the last observation and its infos.
    * ``"disabled"``: the user calls ``reset(options={"reset_mask": mask})``.

    Infos are ``episode_return`` (sum of the episode's rewards), ``episode_length`` (control
    steps) and ``non_finite`` (the physics diverged and ended the episode), each (N,), with
    (N,) bool masks such as ``_episode_return`` of the entries that were set.

    ``output`` selects the type of all results:

    * ``"numpy"``: writable arrays; on a CPU observations share memory with JAX. ``final_obs`` is
      an object array with None where no episode ended, and absent if none did.
    * ``"torch"`` and ``"jax"``: arrays on the environment's device. ``final_obs`` and
      ``final_info`` are dense and present in every step, so the host never waits; entries are
      valid where the masks ``_final_obs`` and ``_final_info`` are True.

    Observations are never overwritten, and in-place operations on them change no later result.
    ``call``, ``get_attr`` and ``set_attr`` address a ``SubEnv`` for each environment.

    Methods raise ``ClosedEnvironmentError`` after ``close`` and ``RuntimeError`` in a fork that
    cannot run JAX.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = "next_step",
        output: str = "numpy",
        render_mode: str | None = None,
        render_height: int = 480,
        render_width: int = 480,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Build the environments; the first ``reset`` compiles.

        Args:
            task: one of ``pixelbrax_jax.list_envs()``.
            num_envs: N, at least 1.
            autoreset_mode: ``"next_step"``, ``"same_step"``, ``"disabled"``, or Gymnasium's
                ``AutoresetMode`` or its value.
            output: ``"numpy"``, ``"torch"`` or ``"jax"`` arrays.
            render_mode: None or ``"rgb_array"``.
            render_height: height of ``render()`` in pixels.
            render_width: width of ``render()`` in pixels.
            max_episode_steps: time limit in calls of ``step``, not counting a step that only
                resets; None keeps ``episode_length``, 1000 control steps by default.
            **options: other options of ``pixelbrax_jax.make``, such as ``camera``.

        Raises:
            TypeError: an option is unknown.
            ValueError: an option is out of range.
            ImportError: ``output`` is ``"torch"``, and torch is not installed.
        """
        if render_mode == "human":
            raise ValueError(
                "render_mode='human' shows only one environment: use gymnasium.make for it, or "
                "'rgb_array' here."
            )
        if render_mode is not None:
            check_choice("render_mode", render_mode, ("rgb_array",))
        self.autoreset_mode = as_autoreset_mode(autoreset_mode)
        self._output, self._export = output, exporter(output)
        self._stateful = StatefulEnv(
            GymnasiumVectorEnv,
            task,
            options,
            num_envs=num_envs,
            autoreset_mode=self.autoreset_mode.name.lower(),
            max_episode_steps=max_episode_steps,
            render_size=(render_height, render_width),
        )
        env = self._stateful.env
        self.num_envs = self._stateful.num_envs
        self.single_observation_space = observation_space(env.obs_spec)
        self.single_action_space = action_space(env.action_size)
        self.observation_space = observation_space(env.obs_spec, self.num_envs)
        self.action_space = action_space(env.action_size, self.num_envs)
        self.render_mode = render_mode
        self.metadata = {
            **type(self).metadata,
            "render_fps": self._stateful.fps,
            "autoreset_mode": self.autoreset_mode,
        }

    def reset(
        self,
        *,
        seed: Any = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes; return observations and infos.

        Args:
            seed: s seeds environment i with s + i; a list has one seed for each. A seeded
                environment starts its episode 0; None starts the next episode, or samples a seed
                at the first reset.
            options: ``{"reset_mask": mask}`` with an (N,) bool array or tensor resets only those
                environments, at least one, and repeats the observations of the others.
                ``{"state": state}`` continues from a state of ``get_state``, without a seed.
                Both may be given.

        Raises:
            TypeError: the mask is not a bool array or tensor, a seed not an integer, or the state
                not an ``EnvState``.
            ValueError: the mask has another shape or no True, a seed is out of range or given with
                a state, the state does not fit, or another option is given.
            ResetNeeded: the first reset has a mask with a False.
        """
        given = read_options(options, seed, self.num_envs)
        if "state" not in given:
            # One seed for all also seeds the generator that Gymnasium's wrappers draw from.
            first = None if seed is None or np.ndim(seed) else check_seed(seed)
            gymnasium.vector.VectorEnv.reset(self, seed=first)
        outputs = self._stateful.reset(seed, self.np_random, **given)
        return self._export(outputs["obs"]), self._infos(outputs)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments.

        Args:
            actions: (N, A) floating point, a NumPy array, torch tensor or JAX array whatever
                ``output`` is; rounded to float32 and clipped to [-1, 1].

        Returns:
            Observations; rewards, (N,) float32; terminated and truncated, (N,) bool; infos.

        Raises:
            ResetNeeded: before the first reset; or autoreset is disabled and an ended episode
                was not reset.
            TypeError: the actions are not floating point.
            ValueError: the actions' shape or device is wrong, or a NumPy array or CPU tensor
                contains NaN; nothing is stepped then. NaN elsewhere ends that episode.
        """
        outputs = self._stateful.step(actions)
        flags = (outputs["reward"], outputs["terminated"], outputs["truncated"])
        reward, terminated, truncated = (
            jax.tree.map(np.array, flags) if self._output == "numpy" else self._export(flags)
        )
        return self._export(outputs["obs"]), reward, terminated, truncated, self._infos(outputs)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Render N (render_height, render_width, 3) uint8 images; None without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            return None
        return tuple(to_numpy(self._stateful.render()))

    def get_images(self) -> list[np.ndarray | None]:
        """Return the images of ``render`` as a list, or N times None without a render mode."""
        return list(self.render() or [None] * self.num_envs)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or return the attribute of that name."""
        return tuple(call_sub_envs(self._sub_envs, name, *args, **kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return the attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of the sub-environments to one value, or to N values of a list or tuple.

        Raises:
            ValueError: the list has another length.
        """
        each = values if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(f"expected one value for each of {self.num_envs}, got {len(each)}.")
        for sub_env, value in zip(self._sub_envs, each, strict=True):
            setattr(sub_env, name, value)

    def close_extras(self, **kwargs: Any) -> None:
        """Release the states."""
        del kwargs
        # Gymnasium also calls this on an environment whose construction failed.
        if hasattr(self, "_stateful"):
            self._stateful.close()

    @cached_property
    def _sub_envs(self) -> list[SubEnv]:
        spaces = (self.single_observation_space, self.single_action_space)
        return [SubEnv(self, i, *spaces) for i in range(self.num_envs)]

    def _infos(self, outputs: Mapping[str, Any]) -> dict[str, Any]:
        info, is_numpy = dict(outputs["info"]), self._output == "numpy"
        final_obs, final_info = info.pop("final_obs", None), info.pop("final_info", None)
        # Copying a few numbers is faster than making views.
        numbers = partial(jax.tree.map, np.array) if is_numpy else self._export
        infos = _with_masks(numbers(info), numbers(outputs["reported"]))
        if final_obs is None:
            return infos
        done = numbers(outputs["done"])
        if is_numpy and not done.any():
            return infos
        final_obs, final_info = self._export(final_obs), numbers(final_info)
        if is_numpy:
            rows = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                # A copy: a view would keep the frames of all environments alive.
                rows[i] = jax.tree.map(lambda x, i=i: x[i].copy(), final_obs)
            # Zero where no episode ended, as in Gymnasium's own vector environments.
            for value in final_info.values():
                value[~done] = 0
            final_obs = rows
        ended = {"final_obs": final_obs, "final_info": _with_masks(final_info, done)}
        return infos | _with_masks(ended, done)


def _with_masks(infos: dict[str, Any], mask: Any) -> dict[str, Any]:
    """Add the mask ``_key`` of valid entries for each ``key``."""
    return infos | {f"_{name}": mask for name in infos}


def as_autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Convert the name or value of an autoreset mode to Gymnasium's member."""
    for known in AutoresetMode:
        if mode in (known, known.value):
            return known
    modes = [known.name.lower() for known in AutoresetMode]
    return AutoresetMode[check_choice("autoreset_mode", mode, modes).upper()]
