"""An environment that keeps its state: what every adapter is built on."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from gymnasium import error
from gymnasium.envs.registration import EnvSpec

from pixelbrax_gym.interop.actions import as_actions, name_rows
from pixelbrax_gym.interop.export import read_under_guard
from pixelbrax_gym.interop.fork import check_not_forked, is_forked
from pixelbrax_gym.programs import Programs, draw_images
from pixelbrax_gym.seeds import SEEDS, seeds_of
from pixelbrax_jax import EnvConfig, PixelEnv, VectorPixelEnv, make
from pixelbrax_jax.config import env_config
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.types import EnvParams, EnvState
from pixelbrax_jax.validation import check_positive_int

_made: deque[tuple[EnvConfig, PixelEnv, EnvParams]] = deque(maxlen=64)
"""Options of the latest environments, so that forks of this process can name them."""


class StatefulEnv:
    """``num_envs`` pixel environments and their present states.

    ``reset`` and ``step`` return *outputs*: a dict with ``obs``, ``reward``, ``terminated``,
    ``truncated``, ``done`` and ``info``, as ``Timestep`` has them, of JAX arrays that nothing
    reads again. They may be handed out without a copy.

    Environment i that was seeded with s draws everything from ``jax.random.key(s)``; neither
    i nor ``num_envs`` matters.

    Attributes:
        env: the pixel environment.
        params: its parameters.
        num_envs: N.
        single: whether outputs lack the leading axis; N is then 1.
        episode_length: time limit in control steps.
    """

    def __init__(
        self,
        task: str,
        options: Mapping[str, Any],
        *,
        num_envs: int = 1,
        autoreset_mode: str = "disabled",
        single: bool = False,
        max_episode_steps: int | None = None,
        also_allowed: Sequence[str] = (),
    ) -> None:
        """Build the environment; nothing is compiled yet.

        Args:
            task: one of ``pixelbrax_jax.list_envs()``.
            options: fields of ``pixelbrax_jax.EnvConfig``.
            num_envs: N.
            autoreset_mode: as in ``VectorPixelEnv``.
            single: whether outputs lack the leading axis.
            max_episode_steps: time limit in calls of ``step``; None or -1 keeps
                ``options["episode_length"]``, which counts control steps. Of two limits the one
                that is reached first holds.
            also_allowed: option names of the caller, for the message about an unknown one.

        Raises:
            TypeError: an option is unknown; the message lists those there are.
            ValueError: an option is out of range; the message lists what is allowed.
            MemoryError: observations would not fit into this machine's memory.
            RuntimeError: this process is a fork that cannot run JAX.
        """
        config = env_config(task, options, also_allowed)
        if max_episode_steps not in (None, -1):
            config = _limited(config, max_episode_steps, "episode_length" in options)
        self.env, self.params = _make(config)
        vector = VectorPixelEnv(self.env, num_envs, autoreset_mode)
        self.num_envs, self.single = vector.num_envs, single
        self.episode_length = config.episode_length
        self._programs = Programs(vector, single)
        self._must_reset = autoreset_mode == "disabled"
        self._state: EnvState | None = None
        self._done: jax.Array | None = None
        self._device: jax.Device | None = None
        self._closed = False

    @property
    def fps(self) -> int:
        """Frames per second of simulated time, at least 1."""
        return max(1, round(1.0 / self.env.dt))

    def reset(
        self,
        seed: int | Sequence[int | None] | None,
        rng: np.random.Generator | None = None,
        mask: np.ndarray | None = None,
    ) -> dict[str, Any]:
        """Reset environments.

        Args:
            seed: s seeds environment i with s + i; a sequence has one seed for each. A seeded
                environment is reset to its episode 0. None goes on to the next episode of an
                environment, or draws a seed if there was none yet.
            rng: where seeds are drawn from; by default from the operating system.
            mask: (N,) bool, which ones to reset; None means all.

        Returns:
            Outputs with reward 0; unmasked environments repeat their observation and flags.

        Raises:
            ResetNeeded: the first reset leaves some environments out.
            ClosedEnvironmentError: after ``close``.
            RuntimeError: this process is a fork that cannot run JAX.
            TypeError: a seed is no integer.
            ValueError: a seed is out of range, or there are not N.
        """
        self._check_usable()
        seeds = seeds_of(seed, self.num_envs)
        where = np.ones(self.num_envs, bool) if mask is None else mask.copy()
        if self._state is None:
            if not where.all():
                raise error.ResetNeeded("the first reset must be of all environments.")
            # Clips are there already, and once for all.
            clips = self.params.clips
            self.params = jax.device_put(self.params.replace(clips=None)).replace(clips=clips)
            rng = np.random.default_rng() if rng is None else rng
            first = int(rng.integers(SEEDS - self.num_envs + 1))
            seeds = [first + i if s is None else s for i, s in enumerate(seeds)]
        given = np.array([s is not None for s in seeds]) & where
        numbers = np.array([s or 0 for s in seeds], np.uint32)
        if given.all():
            self._state, outputs = self._programs.reset(numbers, self.params)
        else:
            assert self._state is not None
            # One call unless some environments are seeded and others are not.
            if (where & ~given).any() or not given.any():
                self._state, outputs = self._programs.reset_where(
                    self._state, where & ~given, where, self.params, None
                )
            if given.any():
                self._state, outputs = self._programs.reset_where(
                    self._state, given, where, self.params, numbers
                )
        self._done = outputs["done"]
        self._device = next(iter(self._done.devices()))
        read_under_guard(outputs)
        return outputs

    def step(self, action: Any, mask: np.ndarray | None = None) -> dict[str, Any]:
        """Step all environments, or some.

        Args:
            action: (N, A) or, of a single environment, (A,); see ``as_actions``.
            mask: (N,) bool, which ones to step; None means all. The others stay as they are.
                Not for a single environment.

        Returns:
            Outputs. Environments that were not stepped repeat their observation, with ``done``
            False; the rest of theirs means nothing.

        Raises:
            ResetNeeded: before the first reset; or an episode has ended and autoreset is disabled.
            ClosedEnvironmentError: after ``close``.
            RuntimeError: this process is a fork that cannot run JAX.
            TypeError: the action is not floating point.
            ValueError: the action has another shape, is elsewhere or contains NaN; nothing
                was stepped.
        """
        self._check_ready("step")
        if self._must_reset:
            self._check_not_done()
        shape = (self.env.action_size,)
        action = as_actions(action, shape if self.single else (self.num_envs, *shape), self.device)
        assert self._state is not None
        if mask is None:
            self._state, outputs = self._programs.step(self._state, action, self.params)
        else:
            self._state, outputs = self._programs.step_where(self._state, mask, action, self.params)
        self._done = outputs["done"]
        read_under_guard(outputs)
        return outputs

    def offset_time_limits(self, control_steps: np.ndarray) -> None:
        """Let the time limits of the present episodes come early.

        Args:
            control_steps: (N,) int, by how much, at least 0 and less than the limit.

        Raises:
            ResetNeeded: before the first reset.
            ClosedEnvironmentError: after ``close``.
            RuntimeError: this process is a fork that cannot run JAX.
        """
        self._check_ready("offset_time_limits")
        assert self._state is not None
        offset = jax.device_put(np.asarray(control_steps, np.int32))
        self._state = self._state.replace(sim=self._state.sim.replace(time_limit_offset=offset))

    def render(self, height: int, width: int) -> jax.Array:
        """Draw the present states, at any size.

        Args:
            height: pixels.
            width: pixels.

        Returns:
            (N, height, width, 3) uint8, row 0 at the top.

        Raises:
            ResetNeeded: before the first reset.
            ClosedEnvironmentError: after ``close``.
            MemoryError: the images would not fit into this machine's memory.
            RuntimeError: this process is a fork that cannot run JAX.
        """
        self._check_ready("render")
        what = f"images of num_envs={self.num_envs}, height={height}, width={width}"
        check_fits(what, 3 * self.num_envs * height * width)
        assert self._state is not None
        return draw_images(self.env, self._state, self.params, height, width)

    def forget(self) -> None:
        """Let go of the states; a ``reset`` comes next."""
        self._state = self._done = None

    def close(self) -> None:
        """Let go of the states; only another ``close`` may follow."""
        self.forget()
        self._closed = True

    @property
    def device(self) -> jax.Device:
        """Where outputs are; known after the first reset."""
        if self._device is None:
            raise error.ResetNeeded("call reset() first.")
        return self._device

    def _check_usable(self) -> None:
        check_not_forked()
        if self._closed:
            raise error.ClosedEnvironmentError("the environment is closed; make a new one.")

    def _check_ready(self, what: str) -> None:
        self._check_usable()
        if self._state is None:
            raise error.ResetNeeded(f"call reset() before {what}().")

    def _check_not_done(self) -> None:
        done = np.atleast_1d(np.asarray(self._done))
        if not done.any():
            return
        if self.single:
            raise error.ResetNeeded("the episode has ended; call reset() before the next step().")
        raise error.ResetNeeded(
            f"the episode of environment {name_rows(done)} has ended and autoreset is disabled; "
            'call reset(options={"reset_mask": mask}) with those entries True before the next '
            "step()."
        )


def with_time_limit(spec: EnvSpec | None, stateful: StatefulEnv) -> EnvSpec | None:
    """Return Gymnasium's description of an environment, with the time limit in it.

    Args:
        spec: what Gymnasium knows of the environment.
        stateful: what was made.
    """
    if spec is None:
        return None
    spec, limit = copy.copy(spec), stateful.episode_length
    # Calls of step(), of which the last one may make fewer control steps than the others.
    spec.max_episode_steps = -(-limit // stateful.env.action_repeat)
    spec.kwargs = {**spec.kwargs, "episode_length": limit}
    spec.kwargs.pop("max_episode_steps", None)
    return spec


def _limited(config: EnvConfig, max_episode_steps: Any, is_limited: bool) -> EnvConfig:
    """Return options whose time limit is no longer than so many calls of ``step``."""
    limit = check_positive_int("max_episode_steps", max_episode_steps) * config.action_repeat
    # Whichever is reached first, as with Gymnasium's own TimeLimit around an environment.
    limit = min(limit, config.episode_length) if is_limited else limit
    return env_config(config, {"episode_length": limit})


def _make(config: EnvConfig) -> tuple[PixelEnv, EnvParams]:
    if is_forked():
        # What exists can be named in a fork without starting JAX. The worker then fails in
        # reset(), where Gymnasium's AsyncVectorEnv passes errors on; from here it would only see
        # a lost pipe.
        for made, env, params in _made:
            if _is_equal(made, config):
                return env, params
        check_not_forked()
    env, params = make(config)
    # Clips would be put on the device, which starts JAX.
    if params.clips is None and not any(_is_equal(made, config) for made, _, _ in _made):
        _made.append((config, env, params))
    return env, params


def _is_equal(one: EnvConfig, other: EnvConfig) -> bool:
    try:
        return one == other
    except ValueError:  # Arrays of a camera or look, which have no truth value.
        return False
