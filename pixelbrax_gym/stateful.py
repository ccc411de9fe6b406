"""An environment that keeps its state: what every adapter is built on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import error

from pixelbrax_gym.given_state import check_state
from pixelbrax_gym.interop.actions import as_actions, name_rows
from pixelbrax_gym.interop.export import read_under_guard
from pixelbrax_gym.interop.fork import check_not_forked
from pixelbrax_gym.making import limited, make_env
from pixelbrax_gym.packing import Packed
from pixelbrax_gym.programs import programs_of
from pixelbrax_gym.seeds import SEEDS, seeds_of
from pixelbrax_jax import VectorPixelEnv
from pixelbrax_jax.config import env_config
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.types import EnvState

ExtraOf = Callable[[dict[str, Any]], Any]
"""Makes of a call's outputs what an adapter keeps beside the state."""


# Compiled, so that nothing is sent from the host.
_new_frames = jax.jit(partial(jnp.zeros, dtype=jnp.uint8), static_argnums=0)


@dataclass(frozen=True)
class _Snapshot:
    """What is kept between two calls, replaced as a whole or not at all.

    Attributes:
        packed: the states.
        done: () or (N,) bool, whether episodes have ended.
        spare: frames that nothing reads any more; None if there are none.
        shared: whether somebody else may read ``packed``.
        extra: what the adapter keeps beside them.
    """

    packed: Packed
    done: Any
    spare: jax.Array | None = None
    shared: bool = False
    extra: Any = None


class StatefulEnv:
    """``num_envs`` pixel environments and their present states.

    An exception that arrives during a call, such as a ``KeyboardInterrupt``, leaves the states
    before it or those after it. Copies and pickles go on as the original does; a copy shares its
    compiled programs and its arrays, which nothing writes to.

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
        is_limited: whether the caller has given it.
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
        self.is_limited = "episode_length" in options or max_episode_steps not in (None, -1)
        if max_episode_steps not in (None, -1):
            config = limited(config, max_episode_steps, "episode_length" in options)
        self.env, self.params = make_env(config)
        vector = VectorPixelEnv(self.env, num_envs, autoreset_mode)
        self.num_envs, self.single = vector.num_envs, single
        self.episode_length = config.episode_length
        self._programs = programs_of(vector, single)
        self._must_reset = autoreset_mode == "disabled"
        self._snapshot: _Snapshot | None = None
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
        time_limit_offsets: np.ndarray | None = None,
        extra_of: ExtraOf | None = None,
    ) -> dict[str, Any]:
        """Reset environments.

        Args:
            seed: s seeds environment i with s + i; a sequence has one seed for each. A seeded
                environment is reset to its episode 0. None goes on to the next episode of an
                environment, or draws a seed if there was none yet.
            rng: where seeds are drawn from; by default from the operating system.
            mask: (N,) bool, which ones to reset; None means all.
            time_limit_offsets: (N,) int32, control steps by which the time limits of the episodes
                come early, at least 0 and less than the limit; None means 0.
            extra_of: see ``step``.

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
        if self._snapshot is None:
            if not where.all():
                raise error.ResetNeeded("the first reset must be of all environments.")
            rng = np.random.default_rng() if rng is None else rng
            first = int(rng.integers(SEEDS - self.num_envs + 1))
            seeds = [first + i if s is None else s for i, s in enumerate(seeds)]
        given = np.array([s is not None for s in seeds]) & where
        numbers = np.array([s or 0 for s in seeds], np.uint32)
        if given.all():
            packed, outputs = self._programs.reset(numbers, self.params, time_limit_offsets)
            self._replace(packed, outputs, extra_of)
            return outputs
        before = self._latest
        parts: list[tuple[np.ndarray, np.ndarray | None]] = [(where & ~given, None)]
        if given.any():
            # Two calls where some environments are seeded and others are not.
            parts = [part for part in parts if part[0].any()] + [(given, numbers)]
        for mask, new_seeds in parts:
            spare = self._spare(before)
            packed, outputs = self._programs.reset_where(
                before.packed, mask, where, self.params, new_seeds, time_limit_offsets, spare
            )
            before = _Snapshot(packed, outputs["done"])
        self._replace(packed, outputs, extra_of)
        return outputs

    def step(
        self, action: Any, mask: np.ndarray | None = None, extra_of: ExtraOf | None = None
    ) -> dict[str, Any]:
        """Step all environments, or some.

        Args:
            action: (N, A) or, of a single environment, (A,); see ``as_actions``.
            mask: (N,) bool, which ones to step; None means all. The others stay as they are.
                Not for a single environment.
            extra_of: makes of the outputs what ``extra`` returns until the next call; it and the
                states are replaced at once.

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
        before = self._latest
        spare = self._spare(before)
        if mask is None:
            packed, outputs = self._programs.step(before.packed, action, self.params, spare)
        else:
            packed, outputs = self._programs.step_where(
                before.packed, mask, action, self.params, spare
            )
        self._replace(packed, outputs, extra_of)
        return outputs

    @property
    def extra(self) -> Any:
        """What ``extra_of`` made of the last call's outputs; None if there was none."""
        return None if self._snapshot is None else self._snapshot.extra

    def replace_extra(self, extra: Any) -> None:
        """Replace ``extra``, and nothing else."""
        self._snapshot = replace(self._latest, extra=extra)

    def get_state(self) -> EnvState:
        """Return the present states, with which ``set_state`` goes on to the bit.

        Raises:
            ResetNeeded: before the first reset.
            ClosedEnvironmentError: after ``close``.
            RuntimeError: this process is a fork that cannot run JAX.
        """
        self._check_ready("get_state")
        self._snapshot = replace(self._latest, shared=True)
        return self._programs.state(self._latest.packed, self.params)

    def set_state(self, state: Any, mask: np.ndarray | None = None) -> dict[str, Any]:
        """Go on from given states.

        Args:
            state: what ``get_state`` returned here or of another environment of the same options,
                or ``PixelEnv.reset`` and ``PixelEnv.step`` did; also of NumPy arrays.
            mask: (N,) bool, which environments; None means all. Not for a single environment.

        Returns:
            Outputs as of ``reset``.

        Raises:
            TypeError: it is no ``EnvState``.
            ValueError: it has other parts, shapes or types; the message names the first.
            ResetNeeded: before the first reset some environments are left out.
            ClosedEnvironmentError: after ``close``.
            RuntimeError: this process is a fork that cannot run JAX.
        """
        self._check_usable()
        check_state(state, self._programs.state_spec(self.params))
        if mask is None:
            packed, outputs = self._programs.start(state, self.params)
        elif self._snapshot is None:
            raise error.ResetNeeded("the first reset must be of all environments.")
        else:
            packed, outputs = self._programs.start_where(
                self._snapshot.packed, mask, state, self.params
            )
        self._replace(packed, outputs, None)
        return outputs

    def set_time_limit(self, control_steps: int) -> None:
        """Set the time limit of all episodes, the present ones too.

        Args:
            control_steps: at least 1.
        """
        if control_steps == self.episode_length:
            return
        limit: Any = np.int32(control_steps)
        if self._device is not None:
            limit = jax.device_put(limit, self._device)
        self.params = self.params.replace(episode_length=limit)
        self.episode_length = control_steps

    @property
    def max_episode_steps(self) -> int:
        """Time limit in calls of ``step``, of which the last may make fewer control steps."""
        return -(-self.episode_length // self.env.action_repeat)

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
        return self._programs.images(self._latest.packed, self.params, height, width)

    def forget(self) -> None:
        """Let go of the states; a ``reset`` comes next."""
        self._snapshot = None

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

    def __deepcopy__(self, memo: dict[int, Any]) -> StatefulEnv:
        """Return an environment that goes on by itself, and shares what neither writes to."""
        copied = memo[id(self)] = object.__new__(type(self))
        if self._snapshot is not None:
            self._snapshot = replace(self._snapshot, shared=True, spare=None)
        copied.__dict__.update(self.__dict__)
        if self._snapshot is not None:
            # It may be handed out, and written to then.
            extra = jax.tree.map(lambda x: x.copy(), self._snapshot.extra)
            copied._snapshot = replace(self._snapshot, extra=extra)
        return copied

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: arrays in the host's memory, no device."""
        snapshot = self._snapshot
        if snapshot is not None:
            arrays = jax.device_get((snapshot.packed, snapshot.done, snapshot.extra))
            snapshot = _Snapshot(arrays[0], arrays[1], extra=arrays[2])
        params = jax.device_get(self.params)
        return self.__dict__ | {"_snapshot": snapshot, "_device": None, "params": params}

    def _check_usable(self) -> None:
        check_not_forked()
        if self._closed:
            raise error.ClosedEnvironmentError("the environment is closed; make a new one.")
        self._place()

    @property
    def _latest(self) -> _Snapshot:
        assert self._snapshot is not None
        return self._snapshot

    def _replace(self, packed: Packed, outputs: dict[str, Any], extra_of: ExtraOf | None) -> None:
        """Take the states after a call in place of those before it."""
        before = self._snapshot
        spare = None if before is None or before.shared else before.packed.frames
        read_under_guard(outputs)
        extra = None if extra_of is None else extra_of(outputs)
        self._snapshot = _Snapshot(packed, outputs["done"], spare, extra=extra)

    @staticmethod
    def _spare(snapshot: _Snapshot) -> jax.Array:
        """Return memory for the next frames."""
        # An interrupted call has taken the spare and left nothing in its place.
        if snapshot.spare is None or snapshot.spare.is_deleted():
            return _new_frames(snapshot.packed.frames.shape)
        return snapshot.spare

    def _place(self) -> None:
        """Put what a pickle has brought on the device, and find out which one it is."""
        if self._device is not None:
            return
        snapshot = self._snapshot
        if snapshot is not None:
            packed, done, extra = jax.device_put((snapshot.packed, snapshot.done, snapshot.extra))
            self._snapshot = _Snapshot(packed, done, extra=extra)
        self.params = jax.device_put(self.params)
        self._device = next(iter(self.params.episode_length.devices()))

    def _check_ready(self, what: str) -> None:
        self._check_usable()
        if self._snapshot is None:
            raise error.ResetNeeded(f"call reset() before {what}().")

    def _check_not_done(self) -> None:
        done = np.atleast_1d(np.asarray(self._latest.done))
        if not done.any():
            return
        if self.single:
            raise error.ResetNeeded("the episode has ended; call reset() before the next step().")
        raise error.ResetNeeded(
            f"the episode of environment {name_rows(done)} has ended and autoreset is disabled; "
            'call reset(options={"reset_mask": mask}) with those entries True before the next '
            "step()."
        )
